"""Point clouds: geometry, ray casting and cameras. Imports nothing else of this package."""
