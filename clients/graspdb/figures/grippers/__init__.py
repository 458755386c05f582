"""Figures of gripper profiles."""
