"""Proposes 3D boxes for whole recordings, in one process, in several, or on a cluster."""
