"""What all commands share: arguments, execution, progress, interrupts, errors.

May import ``core``.
"""
