"""Signs of other masters on the bus, and of other faults in what arrives: packets heard, and values read back."""
