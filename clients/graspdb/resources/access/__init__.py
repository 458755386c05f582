"""What takes a key with the scope ``admin``: keys themselves, and the audit."""
