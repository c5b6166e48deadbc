"""Recursive Cross-View: from 2D boxes to oriented 3D boxes. Knows no file and no user interface."""
