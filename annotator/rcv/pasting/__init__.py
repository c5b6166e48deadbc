"""Reviewed objects that are put into other frames, for training."""
