"""Grasps in physics: poses of a chunk in, labelled outcomes out."""
