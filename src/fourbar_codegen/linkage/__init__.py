"""A planar linkage by its points -> System, Model."""
