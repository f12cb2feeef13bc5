"""Mechanisms behind the fake servos."""
