"""What is drawn: shapes of grippers and objects, and their colours, as arrays. No viser here."""
