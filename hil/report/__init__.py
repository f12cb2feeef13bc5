"""A run as one HTML page that needs no network: words first, then numbers and pictures. One section per module."""
