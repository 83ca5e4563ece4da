"""Measurements that the README shows, each made by a command: ``python -m drgs.bench NAME``.

Layer 5.
"""
