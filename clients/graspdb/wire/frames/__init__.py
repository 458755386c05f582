"""Frames: those of a gripper by their names, and the axes that other projects give a gripper."""
