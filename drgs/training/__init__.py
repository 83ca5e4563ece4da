"""The training loop and its parts.

May import everything but the commands, the plugins and ``bench``.
"""
