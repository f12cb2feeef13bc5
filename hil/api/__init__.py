"""What `import hil` offers: the commands as functions, and their result types."""
