"""Other methods applied to the recording of a run, compared with its result."""
