"""Models for others: wheels, C libraries, FMUs."""
