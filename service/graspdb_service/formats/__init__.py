"""HTTP formats: bodies to checked arrays, arrays to answers, and which of them a request means."""
