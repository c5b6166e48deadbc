"""Semi-automatic 3D annotation from a few 2D boxes."""
