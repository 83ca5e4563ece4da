# Corrected by .ci/typings.py from the stubs of Mitsuba 3.9.1
"""Functions for evaluating and sampling Catmull-Rom splines"""
