"""Other published identification methods, for comparison on the same data."""
