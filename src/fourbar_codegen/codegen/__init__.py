"""Schedule -> text: C, Cython and the manifest. What is printed here was decided before."""
