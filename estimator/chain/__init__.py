"""Identification of spatial serial arms with any number of joints, given their geometry."""
