"""Estimate results from recordings, derive physical quantities, and compare results."""
