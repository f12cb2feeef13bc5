"""Export of an identified arm and its recording to the formats of other tools, one module per format."""
