"""Parts of all commands: arguments, execution, progress, their ends.

May import ``core``.
"""
