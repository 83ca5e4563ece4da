"""One picture as Mitsuba wants it: sensors, film, samples, background, surfaces.

May import ``accuracy``, ``effects``, ``splatting``, ``data``, ``io``, ``config``, ``gaussians``,
``cameras`` and ``core``.
"""
