"""The run half's compiled part: C headers that kernels include, and the module that calls kernels."""
