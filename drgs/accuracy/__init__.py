"""Alternatives to the default approximations, each imported when it is chosen."""
