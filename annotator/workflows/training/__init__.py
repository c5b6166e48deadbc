"""Trains a project's detectors, and reports on trained ones."""
