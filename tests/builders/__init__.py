"""Models that several test modules use; those that only one uses stand there."""
