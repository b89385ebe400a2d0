"""One module per kind of rendered data."""
