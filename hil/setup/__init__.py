"""Servos made ready: scan, settings, preflight checks, a new arm's file."""
