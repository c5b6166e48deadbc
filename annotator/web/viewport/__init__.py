"""3D viewports: one viser server on loopback for each, reached through the application's port."""
