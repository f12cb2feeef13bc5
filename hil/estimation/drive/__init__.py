"""What drove the motors: currents that differ from the commanded ones, and a supply that sags."""
