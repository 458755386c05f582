"""The process boundary: chunks are simulated in processes that may die, hang or be anywhere."""
