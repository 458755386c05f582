"""What there is on the service, a class a noun: objects with their trials, sweeps, grippers, kernels."""
