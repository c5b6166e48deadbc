"""Live detection: frames from a device or a played recording are detected, shown and optionally recorded."""
