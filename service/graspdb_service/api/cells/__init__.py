"""Routes of robots and scenes."""
