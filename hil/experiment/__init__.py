"""Run an experiment on the bus: stream goals, check every sample, and stop the arm."""
