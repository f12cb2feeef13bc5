"""Preparing servos for an experiment: taking over held arms, saving and restoring settings, and checking each servo."""
