"""Pages of shape from depth: Table 2, its ablations and losses, priors and scans."""
