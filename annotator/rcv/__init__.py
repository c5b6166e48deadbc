"""Recursive Cross-View: from 2D boxes to oriented 3D boxes. Independent of files and user interfaces."""
