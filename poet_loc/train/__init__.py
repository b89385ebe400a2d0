"""Training of detectors and pose networks."""
