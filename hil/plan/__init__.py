"""What is played: one period of torque, the software spring and damper, the brake."""
