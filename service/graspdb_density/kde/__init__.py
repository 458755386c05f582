"""Kernel density estimates on SE(3): evaluation, sampling, weights, similarity."""
