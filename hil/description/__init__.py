"""Descriptions of an arm's mechanism, read from URDF files. Imports nothing else of hil."""
