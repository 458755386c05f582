"""What two engines say of the same poses, and why they differ."""
