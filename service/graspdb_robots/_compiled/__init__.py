"""Compiled loops over the joints of a chain, and over points."""
