"""What all use cases run on: compute threads, caches, idempotency."""
