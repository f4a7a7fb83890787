"""The run half's compiled part: C headers that kernels include, and the Cython modules that call kernels."""
