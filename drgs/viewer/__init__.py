"""Fits and Gaussians that somebody looks at while a process renders them.

May import ``training`` and what that may import.

What is asked for (``optics``, ``frames``), when it is rendered (``wishes``, ``pace``,
``spectators``) and what may be done to a fit (``watching``) know nothing of a browser. ``server``
and the two pages are what viser needs.
"""
