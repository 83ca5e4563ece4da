"""Measure drgs; write tables and plots.

A measurement that users make on their own machine is a command, ``drgs bench NAME``; one that was
made once is a script in ``scenes/studies``.
"""
