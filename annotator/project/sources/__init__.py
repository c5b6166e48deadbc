"""Proposals from other software, beside our own: one proposal for each object, which holds what every source says."""
