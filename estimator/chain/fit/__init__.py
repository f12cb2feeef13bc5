"""Parameters of a chain estimated from recordings."""
