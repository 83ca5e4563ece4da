"""Files: Gaussians, points, COLMAP's models, images, animations, figures; needs no libLLVM."""
