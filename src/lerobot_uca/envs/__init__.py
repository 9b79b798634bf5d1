"""Simulated tasks with point-cloud observations."""
