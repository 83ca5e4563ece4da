"""Measure drgs; write tables and plots.

Each measurement shown in the documents is a command, ``drgs bench NAME``.
"""
