"""nuScenes: boxes, scenes and sensors as tables that name each other by tokens.

model.py   the tables
shapes.py  boxes, poses and points as they are written
tables.py  the rows of a dataset, frame by frame; write.py: the folder that the devkit opens
read.py    the boxes of datasets, ours and others'
"""

from annotator.formats.nuscenes.read import NuScenesBox, read_nuscenes
from annotator.formats.nuscenes.write import write_nuscenes

__all__ = ["NuScenesBox", "read_nuscenes", "write_nuscenes"]
