"""Comparison of a run's result with those of other methods."""
