"""Find out where photographs were taken.

By COLMAP's structure from motion.
"""
