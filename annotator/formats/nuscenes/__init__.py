"""nuScenes: tables of boxes, scenes and sensors that refer to each other by tokens.

model.py   the tables
shapes.py  boxes, poses and points in nuScenes' form
tables.py  builds the rows of a dataset, frame by frame
write.py   writes a folder that the devkit opens
read.py    reads the boxes of any nuScenes dataset
"""

from annotator.formats.nuscenes.read import NuScenesBox, read_nuscenes
from annotator.formats.nuscenes.write import write_nuscenes

__all__ = ["NuScenesBox", "read_nuscenes", "write_nuscenes"]
