"""Simulation of chains: with sensitivities, in closed loop, and for observing an arm while it moves."""
