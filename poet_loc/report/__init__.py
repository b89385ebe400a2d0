"""Numbers and pictures from records and trajectories."""
