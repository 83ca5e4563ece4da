"""Initial Gaussians from points, masks or cameras, and defaults that follow from the dataset."""
