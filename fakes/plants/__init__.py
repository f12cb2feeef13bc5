"""Mechanisms driven by the fake servos."""
