"""Simulated motion of chains: with sensitivities, in closed loop, and observed while an arm moves."""
