"""Bundles: objects with everything about them in one file, which another GraspDB takes in whole."""
