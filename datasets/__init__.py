"""Datasets (implicit-bench): shapes, meshes, photographs, views, and what is observed of them."""
