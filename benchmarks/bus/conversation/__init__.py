"""A host that exchanges bytes with fake servos and compares every answer with the manual."""
