"""Multisines, and multisines designed for the worst relative standard error."""
