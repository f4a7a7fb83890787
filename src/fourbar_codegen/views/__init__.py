"""Files, figures, animations and reports of results."""
