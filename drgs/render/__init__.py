"""``drgs render``: images of Gaussians, of a fit, of a Mitsuba scene.

May import everything but other commands.
"""
