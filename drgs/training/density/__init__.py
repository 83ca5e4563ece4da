"""How the number of Gaussians changes during a fit: strategies, of which a fit has one.

May import what ``training`` may, but nothing of the trainer: see ``strategy.DensityStrategy``.
"""
