"""``drgs export``: finished Gaussians for other programs, cleaned, decimated, or as a mesh.

May import everything but other commands.
"""
