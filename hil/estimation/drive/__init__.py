"""Detection of currents that differ from the commanded ones, and of supply sag."""
