"""Questions about grasps, and their answers that are kept."""
