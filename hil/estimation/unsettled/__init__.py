"""Recordings that hold no settled period: CSV files, and runs that were cut short."""
