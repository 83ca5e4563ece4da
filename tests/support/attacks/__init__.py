"""Attacks on the commands: hostile files, values, options, and failures of the machine.

An attack (``attack``) is a command line, what is done to the files that it meets (``workshop``),
and perhaps a fault that strikes while it runs (``observer``). ``trial`` runs one and says what it
did that no command may do; ``catalogue`` has all attacks by families and by name. Most run in the
process of the tests; what may end a process runs in one of its own (``server``).

    PYTHONPATH=tests python -m support.attacks            # the families, and how many each has
    PYTHONPATH=tests python -m support.attacks NAME...    # those attacks, with what they print
"""
