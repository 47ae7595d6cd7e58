"""Configurations (implicit-bench): YAML only; a package, so that it is installed."""
