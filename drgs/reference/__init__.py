"""The float64 numpy reference: the paper's equations in readable loops.

Imports nothing of drgs; imported by tests, ``bench`` and ``scenes`` only.
"""
