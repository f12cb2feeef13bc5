"""Switches the servos' torque on with armed watchdogs, and off with read-back."""
