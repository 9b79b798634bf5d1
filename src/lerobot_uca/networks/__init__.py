"""Networks, without any knowledge of LeRobot."""
