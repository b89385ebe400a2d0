"""From images to object poses with stamps, scores and covariances."""
