"""Descriptions of an arm's mechanism, read from URDF and MJCF files. This package imports nothing else from hil."""
