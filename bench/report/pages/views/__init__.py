"""Pages of shape and pose from views of known colours."""
