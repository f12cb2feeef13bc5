"""Horns and encoders that slipped: jumps of the position, and a rest position that changed."""
