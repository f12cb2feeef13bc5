"""Other published methods on the same data."""
