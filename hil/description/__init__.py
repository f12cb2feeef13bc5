"""Descriptions of an arm's mechanism, read from URDF and MJCF files. Imports nothing else from hil."""
