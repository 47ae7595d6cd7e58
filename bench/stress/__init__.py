"""Trials that a renderer passes or fails at a severity, and what theory says of where it fails."""
