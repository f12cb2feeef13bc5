"""Identify the dynamics of servo arms: the experiment, its safety, its files and its command line."""

__version__ = "0.1.0"
