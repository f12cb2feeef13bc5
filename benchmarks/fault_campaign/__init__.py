"""Faults drawn at random against the whole program, judged by what the emulated servos themselves did."""
