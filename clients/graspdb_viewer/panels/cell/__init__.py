"""The robot's cell: its arm, what stands around it, and what the arm reaches."""
