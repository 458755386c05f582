"""Choosing kernel widths, and fitting kernels to trials."""
