"""Files: Gaussians, points, COLMAP's models, pictures, animations, figures; needs no libLLVM.

May import ``core``.
"""
