"""Adjustments of a recording (its up direction, its calibration), and how they move what is stored."""
