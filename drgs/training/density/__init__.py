"""Strategies that change the number of Gaussians, of which a fit has one."""
