"""2D detectors: running them, and training them on labelled boxes."""
