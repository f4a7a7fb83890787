"""A loaded model that evaluates, and what it is asked with."""
