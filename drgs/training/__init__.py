"""The training loop, and what it is made of.

May import everything but the commands, the plugins and ``bench``.
"""
