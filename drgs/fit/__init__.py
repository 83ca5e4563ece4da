"""``drgs fit``: a fit from its configuration to its files, and :func:`drgs.train`.

May import everything but other commands.
"""
