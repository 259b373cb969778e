"""Compiled code: how our kernels are compiled, kept and called. Whatever of Numba is private is touched here alone."""
