"""Rectified stereo pairs: calibration, matching, recordings."""
