"""The error that plants raise."""


class PlantError(ValueError):
    """A plant cannot be created, or returned an invalid state. The message says which one and what is required."""
