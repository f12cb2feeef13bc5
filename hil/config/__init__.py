"""The arm's configuration: the checked TOML file, and the bundled configurations."""
