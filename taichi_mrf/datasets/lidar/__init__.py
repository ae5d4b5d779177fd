"""Lidar scans: point clouds with poses, as frames whose pixels are rays."""
