"""Gradients of a renderer compared with finite differences."""
