"""Splits a data set into training and test frames, and creates recordings of links to them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from annotator.files import new_folder
from annotator.formats.kitti.label_files import read_tracking_labels
from annotator.formats.kitti.label_folders import read_kitti_file
from annotator.mat_file import MatFileError, read_mat
from annotator.recordings import Recording
from annotator.recordings.sunrgbd.scenes import SunRgbdScenes
from annotator.types.errors import ConfigError, FormatError
from annotator.types.messages import amount
from annotator.workflows.evaluating.evaluate_files import read_frame_names
from annotator.workflows.recorded.frame_subset import share_of
from annotator.workflows.recorded.kitti_rows import TRACKING
from annotator.workflows.recorded.reading import frame_number, label_file

# By format: the folders with one file per frame, and the files that all frames share.
LAYOUTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "kitti_object": (("image_2", "velodyne", "calib", "label_2"), ()),
    "kitti_tracking": (("image_02", "velodyne"), ("calib.txt", "label_02.txt")),
    "sunrgbd_extracted": (("image", "calib", "depth", "points", "label"), ()),
    "sunrgbd_scenes": ((), ()),
}
TRAIN_SHARE = 0.5
# VoteNet pads frame numbers to this width in file names, but not in its lists.
VOTENET_DIGITS = 6
# The toolbox's list of all scenes takes about a megabyte.
MOST_LIST_BYTES = 2**26


@dataclass(frozen=True)
class FrameSplit:
    """Frame keys for training and for testing.

    Attributes:
        train, val: sorted keys; they overlap only if the recording has a single frame.
        source: where the split comes from, in words.
        listed: number of frames in the lists; None without lists.
        present: number of listed frames that the recording has; 0 without lists.
    """

    train: tuple[str, ...]
    val: tuple[str, ...]
    source: str
    listed: int | None = None
    present: int = 0

    def coverage(self) -> str:
        """How many of the listed frames the recording has, in words; "" without lists."""
        return "" if self.listed is None else f"{self.present} of {self.listed} listed frames are present"

    def limited(self, limit: int | None, seed: int) -> FrameSplit:
        """The split with at most `limit` frames on each side, drawn at random."""
        if limit is None:
            return self
        return replace(self, train=_drawn(self.train, limit, seed), val=_drawn(self.val, limit, seed))


def split_of(recording: Recording, seed: int) -> FrameSplit:
    """The split by the data set's own lists if they lie beside it, else a random one.

    KITTI: `ImageSets/train.txt` and `val.txt`. SUN RGB-D: VoteNet's `train_data_idx.txt` and `val_data_idx.txt`, or the
    toolbox's `allsplit.mat`.

    Raises:
        ConfigError: another data set's format; or lists that share a frame, or without any frame of the recording.
        FormatError: lists that cannot be read.
    """
    if recording.format not in LAYOUTS:
        raise ConfigError(
            f"{recording.path}: has the format {recording.format}; give the root of KITTI's or SUN RGB-D's frames"
        )
    lists = _own_lists(recording)
    if lists is not None:
        source, train, val = lists
        both = sorted(set(train).intersection(val))
        if both:
            raise ConfigError(
                f"{source}: {amount(len(both), 'frame is', 'frames are')} in the training list and in the test list, "
                f"such as {both[0]}; each frame must be in one list only"
            )
        present = set(recording.keys)
        sides = tuple(sorted(present.intersection(train))), tuple(sorted(present.intersection(val)))
        if not all(sides):
            raise ConfigError(f"{source}: lists no {'test' if sides[0] else 'training'} frame of {recording.path}")
        return FrameSplit(*sides, str(source), len({*train, *val}), sum(map(len, sides)))
    if len(recording) == 1:
        return FrameSplit(recording.keys, recording.keys, "a single frame, for training and testing")
    drawn = _drawn(recording.keys, max(round(TRAIN_SHARE * len(recording)), 1), seed)
    others = tuple(sorted(set(recording.keys).difference(drawn)))
    return FrameSplit(drawn, others, f"random split (no lists found), seed {seed}")


def labelled_classes(recording: Recording) -> frozenset[str]:
    """The classes of a KITTI recording's labels, including small and occluded objects.

    Raises:
        FormatError: labels that cannot be read.
    """
    classes: set[str] = set()
    for key in recording.keys:
        file = label_file(recording, key)
        if file is None or not file.is_file():
            continue
        if recording.format == TRACKING:
            # one file contains all frames
            tracks = read_tracking_labels(file, None)
            return frozenset(truth.label for k in recording.keys for truth in tracks.get(frame_number(file, k), ()))
        classes.update(row.label for row in read_kitti_file(file, scored=False))
    return frozenset(classes)


def link_frames(recording: Recording, keys: Sequence[str], folder: Path) -> None:
    """Creates a folder of links to the frames' files, in the recording's layout; on failure, the folder is removed.

    Raises:
        FormatError: the folder or a link cannot be created.
    """
    folders, files = LAYOUTS[recording.format]
    with new_folder(folder, lambda _: True) as out:
        if isinstance(recording, SunRgbdScenes):
            scenes = dict(zip(recording.keys, recording.scenes, strict=True))
            _link(folder, ((scenes[key], out / key) for key in keys))
            return
        stems = set(keys)
        for name in folders:
            source = recording.root / name
            if source.is_dir():
                (out / name).mkdir()
                paths = (path for path in sorted(source.iterdir()) if path.stem in stems)
                _link(folder, ((path, out / name / path.name) for path in paths))
        _link(folder, ((recording.root / name, out / name) for name in files if (recording.root / name).is_file()))


def _link(folder: Path, pairs: Iterable[tuple[Path, Path]]) -> None:
    try:
        for source, link in pairs:
            link.symlink_to(source.resolve())
    except OSError as error:
        raise FormatError(folder, f"cannot create links to the frames ({error.strerror})") from error


def _drawn(keys: Sequence[str], number: int, seed: int) -> tuple[str, ...]:
    if number >= len(keys):
        return tuple(keys)
    return tuple(sorted(key for _, key in share_of([("", key) for key in keys], number / len(keys), seed)))


def _own_lists(recording: Recording) -> tuple[Path, list[str], list[str]] | None:
    """Path of the training list, the training keys and the test keys; None without lists."""
    root = recording.root
    for folder in (root, root.parent):
        train, val = (folder / "ImageSets" / f"{side}.txt" for side in ("train", "val"))
        if train.is_file() and val.is_file():
            return train, read_frame_names(train), read_frame_names(val)
        train, val = (folder / f"{side}_data_idx.txt" for side in ("train", "val"))
        if train.is_file() and val.is_file():
            return train, _votenet_keys(train), _votenet_keys(val)
        for path in (folder / "allsplit.mat", folder / "SUNRGBDtoolbox" / "traintestSUNRGBD" / "allsplit.mat"):
            if isinstance(recording, SunRgbdScenes) and path.is_file():
                return (path, *_toolbox_lists(path))
    return None


def _votenet_keys(path: Path) -> list[str]:
    return [number.zfill(VOTENET_DIGITS) for number in read_frame_names(path)]


def _toolbox_lists(path: Path) -> tuple[list[str], list[str]]:
    """Training and test keys from the toolbox's cell arrays `alltrain` and `alltest`, which list paths of scenes.

    Raises:
        FormatError: the file cannot be read, or has other content.
    """
    try:
        train, test = (read_mat(path, name, MOST_LIST_BYTES) for name in ("alltrain", "alltest"))
    except (OSError, MatFileError) as error:
        raise FormatError(path, f"the list of scenes cannot be read ({error})") from error
    if not isinstance(train, list) or not isinstance(test, list):
        raise FormatError(path, "alltrain and alltest are not lists of scenes")
    return [_scene_key(str(scene)) for scene in train], [_scene_key(str(scene)) for scene in test]


def _scene_key(path: str) -> str:
    return path.replace("\\", "/").partition("SUNRGBD/")[2].strip("/").replace("/", "__")
