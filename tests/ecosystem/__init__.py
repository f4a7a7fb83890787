"""Other people's models, as they are: accepted, right, and simulated with default settings."""
