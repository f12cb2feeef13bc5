"""Multisine excitation, and its optimisation for the largest relative standard error."""
