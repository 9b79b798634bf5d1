"""Sources of recorded clouds: LeRobot datasets, DP3's zarr, folders of files."""
