"""Cameras in OpenCV axes: one lens a file, motion, viewpoints without photographs, orbits."""
