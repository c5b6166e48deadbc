"""KITTI recordings: object, tracking and raw-drive folders."""
