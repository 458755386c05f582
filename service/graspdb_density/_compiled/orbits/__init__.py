"""Compiled loops over attempts that a symmetry takes elsewhere: each counts by its nearest image."""
