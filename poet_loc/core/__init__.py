"""The vocabulary: geometry, records, trajectories and errors, on numpy and scipy alone."""
