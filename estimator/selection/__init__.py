"""Friction model selection by held-out error, and validation of the result."""
