"""Communication with the servos: packets, control tables, clocks, ports, set-up work and the control cycle."""
