"""Who may ask: the guard before every route, what browsers may do, and the routes of keys and audit."""
