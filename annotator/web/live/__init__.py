"""The live page: a viser server that shows the latest frame of a live pipeline with its detections."""
