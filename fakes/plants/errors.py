"""The error raised by plants."""


class PlantError(ValueError):
    """A plant cannot be created or has returned an invalid state. The message names it and states the requirement."""
