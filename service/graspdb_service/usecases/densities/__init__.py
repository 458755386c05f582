"""Densities and success models of an object, built once a revision and kept."""
