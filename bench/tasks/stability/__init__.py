"""Stress tests: at which severity a renderer fails."""
