"""Start of a fit: initial Gaussians from points, masks or cameras, and defaults from the dataset.

May import ``datasets`` and what that may import.
"""
