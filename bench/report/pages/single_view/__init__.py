"""Pages of shape from one image."""
