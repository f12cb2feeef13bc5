"""Torque of the servos: switched on with armed watchdogs, and off with read-back."""
