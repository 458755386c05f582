"""Foreign mesh files: readers that trust nothing, repair, and the process that bounds them."""
