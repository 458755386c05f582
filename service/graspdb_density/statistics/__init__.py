"""Have we tried enough: convergence of densities, and what is marginal of them."""
