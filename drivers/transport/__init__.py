"""Moves bytes, to a deadline. Nothing of a third-party library's errors leaves this package."""
