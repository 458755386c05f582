"""What answers promised against what became of the trials that tried them."""
