"""Detection of defects in recordings from their effects on the residuals."""
