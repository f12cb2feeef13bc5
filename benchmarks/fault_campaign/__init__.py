"""Random faults injected while the complete program runs, judged from the emulated servos' own record."""
