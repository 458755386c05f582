"""Bodies in and out: JSON, NDJSON, columns, Arrow IPC."""
