"""How viewers render Gaussians: with a low-pass filter of 0.3 square pixels, uncompensated."""

USUAL = {"low_pass": 0.3, "antialiased": False}
"""Of the section ``model`` of a configuration."""
