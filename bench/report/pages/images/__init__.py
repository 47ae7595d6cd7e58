"""Pages of shape and colour from photographs."""
