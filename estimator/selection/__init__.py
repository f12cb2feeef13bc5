"""Friction chosen by held-out error, and what the result is worth."""
