"""Files: Gaussians and points as PLY, pictures and animations; needs no libLLVM.

May import ``core``.
"""
