"""Results of an identification as frozen dataclasses, and their conversion to and from result.json."""
