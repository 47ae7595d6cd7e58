"""Volume renderers: field values become opacities, and a rendered quantity is a weighted sum over a ray's samples."""
