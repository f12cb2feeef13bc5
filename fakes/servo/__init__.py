"""One servo's control table as a state machine."""
