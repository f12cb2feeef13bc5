"""The report's sections, one per module. Each gives a Section, or None where the run does not hold what it shows."""
