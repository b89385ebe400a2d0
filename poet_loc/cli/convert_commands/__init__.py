"""One module per format that poet-loc convert knows."""
