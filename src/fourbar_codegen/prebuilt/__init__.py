"""Models compiled with the package, from the sources in generated/."""
