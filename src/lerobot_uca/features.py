"""Names of the features that datasets, environments and policies share, besides LeRobot's own."""

OBS_POINT_CLOUD = "observation.point_cloud"
"""(N, 3) float32 [m], in the frame that the environment or robot states."""
