"""Results in files, figures, animations and reports."""
