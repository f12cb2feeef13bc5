"""Processes that start without the half second to a second that importing numpy, scipy, numba and hil takes."""
