"""The arm's equations and parameters."""
