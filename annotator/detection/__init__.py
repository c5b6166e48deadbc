"""2D detectors: running them, and training them from labelled boxes."""
