"""Writes the tuned settings of methods."""
