"""Trained policies outside of LeRobot."""
