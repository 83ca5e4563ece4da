"""Look at Gaussians in a browser, rendered live."""
