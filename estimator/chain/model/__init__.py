"""Rigid-body dynamics of a chain, its parameters and their prior."""
