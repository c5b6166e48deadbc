"""Tracks of objects through a recording: linking boxes, and carrying boxes from one frame to others."""
