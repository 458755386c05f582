"""How success falls off around a successful grasp."""
