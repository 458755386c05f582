"""Sweeps, the queue of their jobs, and the packed outcomes that workers hand in."""
