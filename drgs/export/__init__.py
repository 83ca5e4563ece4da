"""Write Gaussians for other programs.

They may be cleaned, decimated, merged, or made a mesh before.
"""
