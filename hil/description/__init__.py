"""Descriptions of an arm's mechanism: what URDF files say. Imports nothing else of hil."""
