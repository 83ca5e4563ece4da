"""Rendering of images for Mitsuba: sensors, film, samples, background, surfaces.

May import ``accuracy``, ``effects``, ``splatting``, ``data``, ``io``, ``config``, ``gaussians``,
``cameras`` and ``core``.
"""
