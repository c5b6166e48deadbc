"""The readers: name -> "module:function". A new format is one file and one line here."""

from __future__ import annotations

# In the order of asking; the first reader that recognises a path gets it. A function takes the path and
# returns a Recording, or NotFound with what it had looked for.
READERS: dict[str, str] = {
    "rgbd_folder": "annotator.recordings.rgbd_folder:open_rgbd_folder",
    "kitti_object": "annotator.recordings.kitti_object:open_kitti_object",
    "kitti_tracking": "annotator.recordings.kitti_tracking:open_kitti_tracking",
    "kitti_raw": "annotator.recordings.kitti_raw:open_kitti_raw",
    "azure_kinect": "annotator.recordings.azure_kinect:open_azure_kinect",
    "sunrgbd_extracted": "annotator.recordings.sunrgbd_extracted:open_sunrgbd_extracted",
    "sunrgbd_scenes": "annotator.recordings.sunrgbd_scenes:open_sunrgbd_scenes",
    # after all that have clouds among other things
    "cloud_folder": "annotator.recordings.cloud_folder:open_cloud_folder",
}

# Where opening takes long: says whether the reader would recognise a path.
LOOKS: dict[str, str] = {
    "azure_kinect": "annotator.recordings.azure_kinect:is_azure_kinect",
}
