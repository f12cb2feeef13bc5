"""The experiment on the bus: stream, guard, stop."""
