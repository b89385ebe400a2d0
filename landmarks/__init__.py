"""Relative object poses and a map of landmarks become camera poses."""
