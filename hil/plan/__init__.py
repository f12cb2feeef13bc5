"""Commands of the experiment: excitation, software spring and damper, and brake."""
