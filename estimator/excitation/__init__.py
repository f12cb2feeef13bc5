"""Multisine excitation, and its optimisation to minimise the largest relative standard error."""
