"""The report's sections, one per module. Each returns a Section, or None if the run lacks the data."""
