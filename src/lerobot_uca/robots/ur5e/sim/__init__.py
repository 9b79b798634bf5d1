"""A simulated e-Series controller: the driver does not know the difference."""
