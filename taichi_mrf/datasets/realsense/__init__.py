"""Intel RealSense cameras and their recordings."""
