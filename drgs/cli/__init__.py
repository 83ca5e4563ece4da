"""Arguments, execution, progress and exit of all commands."""
