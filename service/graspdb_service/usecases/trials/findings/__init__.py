"""Posted trials looked at: what is doubtful about them, stored and in words."""
