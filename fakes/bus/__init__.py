"""The half-duplex bus, its timing and its faults."""
