"""Servos that exist only as bytes: control tables, a half-duplex bus, and a simulated arm behind it."""
