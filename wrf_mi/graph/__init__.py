"""The differentiable program: Gaussians and traced paths, and what receivers report of the two."""
