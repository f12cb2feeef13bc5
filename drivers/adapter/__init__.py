"""The serial adapter as the operating system shows it: its device file and its latency timer."""
