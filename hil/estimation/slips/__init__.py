"""Detection of slipped horns and encoders, from jumps of the position or a changed rest position."""
