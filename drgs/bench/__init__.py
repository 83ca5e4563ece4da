"""Measurements shown in the documents, each a command: ``drgs bench NAME``.

May import everything.
"""
