"""Turn a Mitsuba scene into a training set.

May import the packages that commands may import.
"""
