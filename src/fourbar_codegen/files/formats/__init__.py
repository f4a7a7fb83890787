"""The formats of files, each in the module that its suffix names.

A module has functions for the results that it can hold: ``write_trajectory``, ``write_ensemble``,
``write_branch``, which take the result and an open file; ``read_trajectory``, which takes a path; and ``require``, if
it needs a package that may be missing.
"""
