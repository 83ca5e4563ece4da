"""Typed settings of a fit, and the YAML they are read from."""
