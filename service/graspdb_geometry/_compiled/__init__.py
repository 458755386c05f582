"""Numba kernels of the collision test and of ridges."""
