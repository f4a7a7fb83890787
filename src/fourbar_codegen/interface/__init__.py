"""What users give and what they are told: arguments, paths, progress, notebooks."""
