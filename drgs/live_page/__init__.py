"""Live pages in a browser, rendered by this process: of ``drgs view``, and of a running fit.

``frames`` renders and ``scheduler`` chooses times and sizes, both without a browser; ``server``
serves a ``page`` with viser.
"""
