"""A robot's cell: its arm, and what stands around it."""
