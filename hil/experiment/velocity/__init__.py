"""Errors of a servo's velocity reading: its bias, and its lag behind the position."""
