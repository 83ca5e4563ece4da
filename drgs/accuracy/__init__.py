"""Alternatives to the default approximations, each imported when it is chosen.

May import ``splatting``, ``config``, ``gaussians``, ``cameras`` and ``core``.
"""
