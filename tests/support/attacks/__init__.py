"""Attacks on the commands: hostile files, values, options, and failures of the machine.

An attack (``attack``) is a command line, changes to the files that it reads (``attack_folder``),
and perhaps a fault that is raised while it runs. ``trial`` runs one and lists what it did that no
command may do; ``catalogue`` contains all attacks by family and by name. ``server`` runs them in a
process of its own, which they may end.

    ATTACKS='object/*' python -m pytest tests/commands/test_attacks.py -m slow -k attacks_end
"""
