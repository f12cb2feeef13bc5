"""An identified arm and its recording in the formats of other tools. One format per module."""
