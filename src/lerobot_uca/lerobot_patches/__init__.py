"""Everything that this package changes in LeRobot 0.6.1. Each patch says what LeRobot does without it."""
