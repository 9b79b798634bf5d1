"""Checkpoints: their valid content, saving, and resuming a training."""
