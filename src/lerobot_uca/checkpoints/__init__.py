"""What a checkpoint may hold, how it is saved, and how training goes on from it."""
