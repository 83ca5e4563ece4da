"""Strategies that change the number of Gaussians, of which a fit has one.

May import what ``training`` may, but nothing of the trainer.
"""
