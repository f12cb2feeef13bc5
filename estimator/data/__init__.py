"""Recordings, settled periods, segments, and their Fourier coefficients."""
