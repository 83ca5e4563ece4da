"""The method: projection, tiles, compositing, and the adjoint of each.

May import ``gaussians``, ``cameras`` and ``core``.
"""
