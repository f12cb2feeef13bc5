"""A simulated servo: its control table and the behaviour behind it."""
