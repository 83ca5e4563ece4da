"""Find out where photographs were taken, by COLMAP's structure from motion."""
