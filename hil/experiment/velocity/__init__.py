"""What is known of a servo's velocity reading: its bias, and by how much it lags behind the position."""
