"""The arm's file: its TOML checked, and the ready ones that come with hil."""
