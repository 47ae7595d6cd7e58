"""Trains the network of a task, before it runs."""
