"""Browser pages that show Gaussians, or a running fit, rendered live by this process.

May import ``training`` and its dependencies. ``frames`` renders and ``scheduler`` chooses times and
sizes, both without a browser. ``server`` serves ``page`` and ``training_viewer`` with viser.
"""
