"""Camera or object poses and an IMU become a trajectory."""
