"""All the SQL there is: rows in, rows out, inside a transaction that the use cases open."""
