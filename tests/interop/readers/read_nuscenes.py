"""Reads a dataset with the nuscenes-devkit: `read_nuscenes.py ROOT VERSION`. Corners are in the camera frame."""

import json
import sys
from contextlib import redirect_stdout
from importlib.metadata import version
from pathlib import Path

import numpy as np
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import LidarPointCloud
from nuscenes.utils.geometry_utils import BoxVisibility, view_points

nusc = NuScenes(sys.argv[2], sys.argv[1], verbose=False)
# the devkit prints a table; standard output is reserved for the result
with redirect_stdout(sys.stderr):
    nusc.list_scenes()
frames = {}
for sample in nusc.sample:
    path, boxes, K = nusc.get_sample_data(sample["data"]["CAM_FRONT"], box_vis_level=BoxVisibility.NONE)
    cloud = LidarPointCloud.from_file(nusc.get_sample_data_path(sample["data"]["LIDAR_TOP"]))
    records = [nusc.get("sample_annotation", token) for token in sample["anns"]]
    frames[Path(path).stem] = {
        "boxes": [
            {"label": box.name, "corners": box.corners().T.tolist(),
             "centre_px": view_points(box.center[:, None], np.array(K), True)[:2, 0].tolist()}
            for box in boxes
        ],
        "points": int(cloud.points.shape[1]),
        "scene": nusc.get("scene", sample["scene_token"])["name"],
        "instances": [record["instance_token"] for record in records],
    }  # fmt: skip
tracks = {i["token"]: [nusc.get("sample_annotation", i[end])["token"] for end in
                       ("first_annotation_token", "last_annotation_token")] for i in nusc.instance}  # fmt: skip
json.dump({"software": f"nuscenes-devkit {version('nuscenes-devkit')}", "frames": frames, "tracks": tracks}, sys.stdout)
