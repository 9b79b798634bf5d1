"""Making demonstrations and reading datasets."""
