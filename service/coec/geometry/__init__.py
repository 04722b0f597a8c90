"""Arrays in, arrays out: rigid transforms, camera models and compiled kernels. NumPy and numba only."""
