"""A synthetic world of household objects: meshes, labels, scenes, motion, and a rasteriser that needs only a CPU."""
