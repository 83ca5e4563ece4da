"""Files: Gaussians and points as PLY, pictures, animations and figures; needs no libLLVM.

May import ``core``.
"""
