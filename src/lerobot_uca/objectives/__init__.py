"""The objectives of the baselines, without any knowledge of LeRobot. UCA-Flow's own is `lerobot_uca.meanflow`."""
