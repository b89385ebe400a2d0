"""PoET in the order of the paper: backbone, position encodings, deformable transformer, heads, losses, checkpoints."""
