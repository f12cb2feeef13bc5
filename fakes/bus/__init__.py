"""The half-duplex bus, its wires and its faults."""
