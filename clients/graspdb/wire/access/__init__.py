"""API keys, what they may do, and the audit of what was done with them."""
