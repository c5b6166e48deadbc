"""nuScenes: tables of boxes, scenes and sensors that refer to each other by tokens.

model.py   the tables
shapes.py  boxes, poses and points in nuScenes' form
tables.py  builds the rows of a dataset, frame by frame
write.py   writes a folder that the devkit opens
read.py    reads the boxes of any nuScenes dataset
sample_labels.py  reads the boxes of a recording's samples
results.py  reads the boxes of detectors and trackers, in the form of the benchmarks
"""

from annotator.formats.nuscenes.read import ANNOTATIONS, NuScenesBox, is_seen, read_nuscenes, read_world_poses
from annotator.formats.nuscenes.results import read_results
from annotator.formats.nuscenes.sample_labels import read_sample_boxes
from annotator.formats.nuscenes.write import write_nuscenes

__all__ = [
    "ANNOTATIONS",
    "NuScenesBox",
    "is_seen",
    "read_nuscenes",
    "read_results",
    "read_sample_boxes",
    "read_world_poses",
    "write_nuscenes",
]
