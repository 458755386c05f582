"""Answers: kept as they were given, under ids and names, and asked again."""
