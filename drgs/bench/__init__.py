"""Measurements that the documents show, each made by a command: ``drgs bench NAME``.

May import everything.
"""
