"""Render Gaussians, a fit, or a Mitsuba scene.

May import everything but other commands.
"""
