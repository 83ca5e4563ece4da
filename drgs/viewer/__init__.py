"""Pages in a browser that show Gaussians, or a fit that runs, rendered live by this process.

May import ``training`` and what that may import. ``frames`` renders, ``scheduler`` decides when and
how large; neither knows a browser. ``page`` and ``training_viewer`` are the pages, which ``server``
serves with viser.
"""
