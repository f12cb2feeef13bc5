"""Joint-by-joint checks of every sample, and explanations of the faults that they find."""
