"""Scene files: disk <-> :class:`drgs.gaussians.Gaussians`. Layer 1; needs no libLLVM."""

from drgs.io.ply import read_ply, read_points, write_ply

__all__ = ["read_ply", "read_points", "write_ply"]
