"""Pages of one rendering: what it costs, how far it is off, and how true its gradients are."""
