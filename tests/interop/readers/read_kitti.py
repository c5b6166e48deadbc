"""Reads a KITTI object folder with torchvision: `read_kitti.py ROOT`, where ROOT/Kitti/raw is the folder."""

import json
import sys
from pathlib import Path

import torchvision

dataset = torchvision.datasets.Kitti(sys.argv[1])
frames = {}
for index in range(len(dataset)):
    image, objects = dataset[index]
    frames[Path(dataset.images[index]).stem] = {"size": image.size, "objects": objects}
json.dump({"software": f"torchvision {torchvision.__version__}", "frames": frames}, sys.stdout)
