"""The table of readers: name -> "module:function". A new format needs one module and one line here."""

from __future__ import annotations

# Tried in this order; the first reader that recognises a path opens it. A reader takes the path and returns a
# Recording, or NotFound with what it looked for.
READERS: dict[str, str] = {
    "stray_scanner": "annotator.recordings.phones.stray_scanner:open_stray_scanner",
    "record3d": "annotator.recordings.phones.record3d:open_record3d",
    # before rgbd_folder, whose names differ only by the lists of images
    "tum_rgbd": "annotator.recordings.tum_rgbd:open_tum_rgbd",
    "rgbd_folder": "annotator.recordings.rgbd_folder:open_rgbd_folder",
    "kitti_object": "annotator.recordings.kitti:open_kitti_object",
    "kitti_tracking": "annotator.recordings.kitti:open_kitti_tracking",
    "kitti_raw": "annotator.recordings.kitti:open_kitti_raw",
    "azure_kinect": "annotator.recordings.kinect.mkv_recording:open_azure_kinect",
    "ros_bag": "annotator.recordings.ros.recording:open_ros_bag",
    "nuscenes": "annotator.recordings.nuscenes:open_nuscenes",
    "argoverse2": "annotator.recordings.argoverse:open_argoverse2",
    "sunrgbd_extracted": "annotator.recordings.sunrgbd:open_sunrgbd_extracted",
    "sunrgbd_scenes": "annotator.recordings.sunrgbd:open_sunrgbd_scenes",
    "rcv": "annotator.recordings.exports:open_rcv",
    "openlabel": "annotator.recordings.exports:open_openlabel",
    # last, because other formats contain cloud files, too
    "cloud_folder": "annotator.recordings.clouds.cloud_folder:open_cloud_folder",
}

# The options (`ReaderOptions`) that readers take. Such a reader is called with the path and the options.
OPTIONS: dict[str, tuple[str, ...]] = {
    "ros_bag": (
        *("image", "points", "depth", "camera_info", "depth_info", "tf_frame", "no_motion", "tolerance_s", "origin"),
    ),
    "kitti_object": ("columns",),
    "kitti_tracking": ("columns", "scene"),
    "kitti_raw": ("columns",),
    "cloud_folder": ("columns", "origin"),
    "stray_scanner": ("min_confidence",),
    "record3d": ("min_confidence",),
    "tum_rgbd": ("tolerance_s",),
    "nuscenes": ("scene", "camera", "tolerance_s"),
    "argoverse2": ("camera", "tolerance_s"),
}

# Faster recognition checks, for formats that are slow to open.
QUICK_CHECKS: dict[str, str] = {
    "record3d": "annotator.recordings.phones.record3d:is_record3d",
    "azure_kinect": "annotator.recordings.kinect.mkv_recording:is_azure_kinect",
    "ros_bag": "annotator.recordings.ros.files:is_bag",
    "nuscenes": "annotator.recordings.nuscenes:is_nuscenes",
    "argoverse2": "annotator.recordings.argoverse:is_argoverse2",
}
