"""What every route shares: a declared scope, known parameters, cursors and ETags."""
