"""What `import hil` offers: the commands as functions, and what they give back."""
