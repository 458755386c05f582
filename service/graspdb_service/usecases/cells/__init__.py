"""Robots' cells: arms, scenes, and which grasps an arm can take in one."""
