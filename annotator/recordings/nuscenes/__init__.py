"""nuScenes: its tables, and one recording per scene and camera."""
