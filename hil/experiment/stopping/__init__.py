"""Stopping a spatial arm so that it ends at rest: it is braked, then lowered to its rest pose."""
