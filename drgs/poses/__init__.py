"""``drgs poses``: camera poses of photographs by COLMAP's structure from motion.

May import the packages that commands may import.
"""
