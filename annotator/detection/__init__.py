"""2D detectors: running them, and training them on labelled boxes.

What cannot be trained, loaded or run raises `DetectionError`, which says what to do.
"""
