"""The HTTP contract: one router a noun; thin, for the use cases do the work."""
