"""The 3D view of a workbench: one viser server on loopback for each, reached through the application's own port."""
