"""Excitation: motions that reveal a chain's parameters."""
