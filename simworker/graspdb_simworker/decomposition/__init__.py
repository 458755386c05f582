"""Convex parts of a mesh, made in a process that is bounded in time and memory."""
