"""A step of a fit: the trainer and its parts, without folders, clocks and terminals."""
