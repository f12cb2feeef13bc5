"""What a person sees in the terminal: progress, servos, results."""
