"""Where a density is highest under constraints."""
