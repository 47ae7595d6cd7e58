"""What there is to see (implicit-bench): shapes, meshes, photographs, views, and what is observed of them."""
