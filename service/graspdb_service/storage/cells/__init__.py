"""Robots and scenes."""
