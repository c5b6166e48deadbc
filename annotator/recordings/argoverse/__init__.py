"""Argoverse 2's sensor data set: logs with camera images, or of the LiDAR alone."""
