"""The paper that this project started from, on its own arm."""
