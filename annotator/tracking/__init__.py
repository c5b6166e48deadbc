"""Tracks: linking of the boxes of one object over the frames of a recording, smoothing and interpolation.

Pure functions of boxes and times, independent of files, projects and detectors.
"""
