"""Light between splats and surfaces: what rays pass, imported where a scene asks for it.

May import ``splatting``, ``config``, ``gaussians``, ``cameras`` and ``core``.
"""
