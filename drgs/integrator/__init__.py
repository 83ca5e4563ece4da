"""Rendering of images for Mitsuba: sensors, film, samples, background, surfaces."""
