"""Signs of other masters on the bus, and of other communication faults: packets heard, and values read back."""
