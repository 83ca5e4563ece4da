"""Effects of a fit, each imported when it is used.

May import what ``training`` may, but nothing of the trainer.
"""
