"""Compiled code: compiling, storing and calling our kernels. Only this package uses private parts of Numba."""
