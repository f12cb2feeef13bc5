"""The public functions of hil and their result types."""
