"""The results of a fit: its folder, metrics, report, curves and refined cameras.

May import ``integrator``, ``data``, ``io``, ``config``, ``gaussians``, ``cameras`` and ``core``.
"""
