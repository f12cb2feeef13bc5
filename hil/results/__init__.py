"""What an identification found, as frozen dataclasses, and their way to result.json and back."""
