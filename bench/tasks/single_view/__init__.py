"""Shape from one image, by a network that a renderer trains."""
