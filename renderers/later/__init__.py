"""Renderers that are newer than the papers of the core: volumes, meshes, bands and range analysis."""
