"""Real robots for LeRobot."""
