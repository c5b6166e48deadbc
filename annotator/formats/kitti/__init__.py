"""KITTI: object, tracking and raw-drive labels, and detection results."""
