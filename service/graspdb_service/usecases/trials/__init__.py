"""Trials posted, listed, withdrawn; every attempt of a selection."""
