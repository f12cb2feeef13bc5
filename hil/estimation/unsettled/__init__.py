"""Recordings without a settled period: CSV files, and runs that were cut short."""
