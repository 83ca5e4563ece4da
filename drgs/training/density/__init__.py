"""Strategies that change the number of Gaussians; they import nothing of the trainer."""
