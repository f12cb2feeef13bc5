"""Terminal output: progress, servos, results."""
