"""Live: frames as they come, from a device or a recording that is played; detected, shown and perhaps recorded."""
