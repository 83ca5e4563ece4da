"""``drgs capture``: path-traced images of a Mitsuba scene as a dataset.

May import the packages that commands may import.
"""
