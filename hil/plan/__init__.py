"""What the experiment commands: excitation, software spring and damper, brake."""
