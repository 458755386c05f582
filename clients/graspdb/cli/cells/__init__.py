"""``graspdb robots`` and ``graspdb scenes``."""
