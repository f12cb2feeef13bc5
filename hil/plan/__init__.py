"""What the experiment plays: excitation, software spring and damper, brake."""
