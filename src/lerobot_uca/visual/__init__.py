"""Pictures and recordings of what a policy sees and does."""
