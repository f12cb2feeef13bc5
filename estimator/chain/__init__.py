"""Serial arms of any number of joints in space, from a description of their geometry."""
