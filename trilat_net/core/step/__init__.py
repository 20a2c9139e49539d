"""One tick of a site in eight stages, the arrays of all sites, and the fused run."""
