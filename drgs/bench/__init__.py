"""Measurements that the README shows, each made by a command: ``drgs bench NAME``.

May import everything.
"""
