"""Least squares on Fourier lines, then maximum likelihood."""
