"""State estimation from MoCap and IMU."""
