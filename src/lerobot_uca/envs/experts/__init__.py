"""Demonstrators of the simulated tasks."""
