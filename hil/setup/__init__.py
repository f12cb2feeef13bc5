"""Preparation of servos: scan, settings, preflight checks, and the file for a new arm."""
