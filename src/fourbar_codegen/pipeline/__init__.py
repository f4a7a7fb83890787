"""A Model is compiled: here generation and simulation meet."""
