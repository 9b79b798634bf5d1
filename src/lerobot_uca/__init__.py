"""UCA-Flow for LeRobot: a one-step robot policy on 3D point clouds. Start reading at `meanflow.py`."""
