"""Semi-automatic 3D annotation from a few 2D boxes."""

__version__ = "0.1.0"
