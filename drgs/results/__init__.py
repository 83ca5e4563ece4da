"""Shared parts of commands: a fit's folder, history, metrics, models to render, ``viewer.html``."""
