"""What comes in: one reader a format, behind `open_recording`."""
