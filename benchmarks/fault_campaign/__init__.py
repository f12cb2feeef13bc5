"""Random faults against the complete program, judged from the emulated servos' own record."""
