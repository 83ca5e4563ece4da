"""Look at Gaussians in a browser, rendered live.

May import everything but other commands.
"""
