"""The error that plants raise."""


class PlantError(ValueError):
    """A plant cannot be created, or has returned an invalid state. The message names it and says what is required."""
