"""Pages of error over time."""
