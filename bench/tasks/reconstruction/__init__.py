"""Shape and colour from photographs, and the baselines of DVR's Table 2."""
