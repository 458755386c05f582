"""Trials as rows, what groups of them have in common, and the batches they came in."""
