"""Run an experiment on the bus: stream, guard, stop."""
