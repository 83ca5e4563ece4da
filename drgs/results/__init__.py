"""What a fit leaves behind: its folder, metrics, report, curves and refined cameras.

May import ``integrator``, ``data``, ``io``, ``config``, ``gaussians``, ``cameras`` and ``core``.
"""
