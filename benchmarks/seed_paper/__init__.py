"""The method of the paper from which this project started, applied to the paper's own arm."""
