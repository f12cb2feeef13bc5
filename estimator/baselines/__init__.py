"""Methods of others on the same data."""
