"""Stress tests: trials of growing severity, and formulas that predict where a renderer fails."""
