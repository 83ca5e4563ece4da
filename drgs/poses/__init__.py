"""Find out where photographs were taken.

By COLMAP's structure from motion.

May import the packages that commands may import.
"""
