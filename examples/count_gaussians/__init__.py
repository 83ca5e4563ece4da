"""Print the number of Gaussians in a file.

This line is the help of ``drgs count``; the package is imported for it, and imports nothing.
"""
