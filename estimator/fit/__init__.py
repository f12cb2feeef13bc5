"""Least squares on Fourier coefficients, then maximum likelihood."""
