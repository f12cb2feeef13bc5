"""Comparison of two identifications of one arm: parameters and friction."""
