"""Tasks without a renderer: DeepSDF's samples, registration of points, the best fit of a prior."""
