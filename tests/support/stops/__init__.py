"""Runs that are stopped, interrupted or killed."""
