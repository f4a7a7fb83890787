"""Schedule -> text: C, Cython and the manifest. All decisions were made before."""
