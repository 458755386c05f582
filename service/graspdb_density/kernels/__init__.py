"""What one grasp says of its neighbourhood: kernels on SE(3) and their normalisers."""
