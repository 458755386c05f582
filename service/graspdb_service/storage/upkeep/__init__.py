"""What keeps a database in order: copies of it, what must agree with what, what may be deleted."""
