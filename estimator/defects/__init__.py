"""Defects of recordings, told apart by what each would do to the residuals."""
