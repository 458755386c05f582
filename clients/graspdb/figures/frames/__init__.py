"""Figures of grippers: their boxes and frames."""
