"""Bytes and servos: packets, control tables, clocks, ports, set-up work and the control cycle."""
