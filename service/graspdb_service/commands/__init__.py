"""Commands of ``graspdb-server`` beside serving."""
