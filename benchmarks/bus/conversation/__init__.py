"""A host and fake servos that exchange bytes, each answer compared with the manual."""
