"""poet-loc: object-relative localisation from 6D object poses, landmarks and an IMU."""
