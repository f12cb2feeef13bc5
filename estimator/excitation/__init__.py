"""Multisine excitation, optimised to minimise the largest relative standard error."""
