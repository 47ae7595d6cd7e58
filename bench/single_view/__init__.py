"""One image, one shape: an encoder, a decoder of shape and colour, and their training over many shapes."""
