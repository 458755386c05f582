"""What follows from stored trials and is kept for all replicas: lost, it is made again."""
