"""Pictures of objects and grasps, which the service draws."""
