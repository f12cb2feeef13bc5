"""Detection of defects in recordings, which differ in their effect on the residuals."""
