"""Renderers that see through a volume: a field's values become opacity, and what a ray sees is a weighted sum."""
