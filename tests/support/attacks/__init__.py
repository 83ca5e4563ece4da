"""Attacks on the commands: hostile files, values, options, and failures of the machine.

An attack (``attack``) is a command line, changes to the files that it reads (``attack_folder``),
and perhaps a fault that is raised while it runs (``observer``). ``trial`` runs one and lists what
it did that no command may do; ``catalogue`` contains all attacks by family and by name. Most run in
the process of the tests; what may end a process runs in one of its own (``server``).

    PYTHONPATH=tests python -m support.attacks            # the families, and how many each has
    PYTHONPATH=tests python -m support.attacks NAME...    # those attacks, with what they print
"""
