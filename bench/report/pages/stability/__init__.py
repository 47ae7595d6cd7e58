"""Pages of the atlas: where renderers break."""
