"""Render Gaussians, a fit, or a Mitsuba scene."""
