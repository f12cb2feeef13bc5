"""Stops that leave the arm at rest: a spatial arm is braked, then lowered to its rest pose."""
