"""Recordings of other tools as tables and as recordings in SI units: CSV, Parquet and LeRobot, MCAP and ROS 2 bags."""
