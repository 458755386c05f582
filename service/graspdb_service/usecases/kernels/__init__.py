"""Kernels fitted on trials or given, stored and loaded."""
