"""LeRobot policies: a configuration_, a modeling_ and a processor_ module each, as LeRobot expects."""
