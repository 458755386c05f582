"""Widths that the rows themselves choose, once for all replicas."""
