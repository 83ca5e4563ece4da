"""How viewers render Gaussians: with a low-pass filter of 0.3 square pixels, uncompensated."""

VIEWER_RENDERING = {"low_pass": 0.3, "antialiased": False}
"""Values of the configuration's section ``model``."""
