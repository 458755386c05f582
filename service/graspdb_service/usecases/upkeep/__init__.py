"""A service's own affairs: is all in order, and what is kept how long."""
