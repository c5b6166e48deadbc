"""Reads point clouds with Open3D: `read_clouds.py FILE ...`."""

import json
import sys

import numpy as np
import open3d

clouds = {}
for name in sys.argv[1:]:
    cloud = open3d.io.read_point_cloud(name)
    points = np.asarray(cloud.points)
    clouds[name] = {
        "points": len(points),
        "low": points.min(axis=0).tolist(),
        "high": points.max(axis=0).tolist(),
        "colour": (np.asarray(cloud.colors).mean(axis=0) * 255).tolist() if cloud.has_colors() else None,
    }
json.dump({"software": f"open3d {open3d.__version__}", "clouds": clouds}, sys.stdout)
