"""Effects of a fit: they may import what ``training`` may, but nothing of the trainer."""
