"""Import of recordings made by other tools, converted to SI units: CSV, Parquet, LeRobot, MCAP and ROS 2 bags."""
