"""Fit 3D Gaussians to posed photographs.

A fit from its configuration to its files, and :func:`drgs.train`.
"""
