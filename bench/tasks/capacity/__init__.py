"""Fields without a prior: which is the smallest that suffices."""
