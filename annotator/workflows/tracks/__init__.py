"""Objects over a recording: links between frames, boxes carried from one frame to others."""
