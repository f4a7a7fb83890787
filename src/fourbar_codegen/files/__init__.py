"""Results in files, and from files."""
