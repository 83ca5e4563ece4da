"""Cameras in OpenCV axes; one lens a file, and how a camera moves.

May import ``core``.
"""
