"""Use cases: what the service does, free of HTTP and of SQL. They open and commit the transactions."""
