"""Other methods on the recording of a run, compared with its result."""
