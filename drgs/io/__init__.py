"""Files: Gaussians and points as PLY, pictures and animations; needs no libLLVM.

May import ``gaussians`` and ``core``.
"""

from drgs.io.ply import read_ply, read_points, write_ply

__all__ = ["read_ply", "read_points", "write_ply"]
