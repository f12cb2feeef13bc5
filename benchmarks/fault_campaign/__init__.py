"""Random faults against the complete program, judged by what the emulated servos themselves recorded."""
