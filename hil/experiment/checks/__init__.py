"""Checks of every sample, joint by joint, and the explanation of what they find."""
