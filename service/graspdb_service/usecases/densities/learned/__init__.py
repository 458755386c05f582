"""What success probabilities are learned in the background, of an object itself and of others."""
