"""Motions of a chain that reveal its parameters."""
