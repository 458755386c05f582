"""Questions about grasps: the best, how likely, which to try."""
