"""Preparing servos for an experiment: held arms, saving and restoring settings, and checks of each servo."""
