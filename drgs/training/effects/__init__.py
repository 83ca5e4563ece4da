"""What takes part in the iterations of a fit when it is called for.

May import what ``training`` may, but nothing of the trainer: see ``base.FitState``.
"""
