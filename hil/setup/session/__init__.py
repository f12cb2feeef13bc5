"""Sessions with an arm's servos: their settings are saved before the first write and restored after the last."""
