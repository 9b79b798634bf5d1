"""The UR5e: `--robot.type=ur5e_follower`, and a simulated controller to rehearse with."""
