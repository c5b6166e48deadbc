"""The labels that come with recordings, and 2D boxes made from known 3D boxes."""
