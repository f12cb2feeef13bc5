"""The arm's compiled simulation and its forward sensitivities."""
