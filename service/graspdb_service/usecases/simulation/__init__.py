"""Sweeps, and the jobs that workers claim."""
