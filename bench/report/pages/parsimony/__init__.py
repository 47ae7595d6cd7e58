"""Pages of how much model a scene needs."""
