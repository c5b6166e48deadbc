"""Which frames of a data set are learnt from and which are tried, each as a folder of links that is a recording."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from annotator.files import new_folder
from annotator.formats.kitti import read_tracking_labels
from annotator.formats.kitti_results import read_kitti_file
from annotator.mat_file import MatFileError, read_mat
from annotator.recordings import Recording
from annotator.recordings.sunrgbd_scenes import SunRgbdScenes
from annotator.types.errors import ConfigError, FormatError
from annotator.workflows.evaluate import read_frame_names
from annotator.workflows.frame_share import share_of
from annotator.workflows.kitti_view import TRACKING
from annotator.workflows.truth import frame_number, label_file

# Of each format, the folders of one file a frame, and the files that all frames share.
LAYOUTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "kitti_object": (("image_2", "velodyne", "calib", "label_2"), ()),
    "kitti_tracking": (("image_02", "velodyne"), ("calib.txt", "label_02.txt")),
    "sunrgbd_extracted": (("image", "calib", "depth", "points", "label"), ()),
    "sunrgbd_scenes": ((), ()),
}
TRAIN_SHARE = 0.5
# VoteNet numbers its frames with so many digits, and its lists do without the zeros.
VOTENET_DIGITS = 6
# The toolbox's list of all scenes takes about a megabyte.
MOST_LIST_BYTES = 2**26


@dataclass(frozen=True)
class FrameSplit:
    """Keys of a recording's frames.

    Attributes:
        train, val: sorted; they overlap only where there is but one frame.
        source: who divided them, in words.
        listed: how many frames the lists name; None where there are none.
        there: how many of these there are; 0 without lists.
    """

    train: tuple[str, ...]
    val: tuple[str, ...]
    source: str
    listed: int | None = None
    there: int = 0

    def found(self) -> str:
        """How much of the lists there is; "" where there are none."""
        return "" if self.listed is None else f"{self.there} of {self.listed} listed frames are there"

    def limited(self, limit: int | None, seed: int) -> FrameSplit:
        """At most so many frames on each side, drawn by the seed."""
        if limit is None:
            return self
        return replace(self, train=_drawn(self.train, limit, seed), val=_drawn(self.val, limit, seed))


def split_of(recording: Recording, seed: int) -> FrameSplit:
    """The data set's own lists where they lie beside it, else every frame by chance to one side or the other.

    KITTI: `ImageSets/train.txt` and `val.txt`. SUN RGB-D: VoteNet's `train_data_idx.txt` and `val_data_idx.txt`, or the
    toolbox's `allsplit.mat`.

    Raises:
        ConfigError: a format of neither data set; or lists that share a frame, or name none of those that are there.
        FormatError: lists that cannot be read.
    """
    if recording.format not in LAYOUTS:
        raise ConfigError(
            f"{recording.path}: is a recording of the format {recording.format}; give the root of KITTI's or SUN "
            "RGB-D's frames"
        )
    lists = _own_lists(recording)
    if lists is not None:
        source, train, val = lists
        both = sorted(set(train).intersection(val))
        if both:
            raise ConfigError(
                f"{source}: {len(both)} frames are to be learnt from and tried, such as {both[0]}; figures of frames "
                "that were learnt from mean nothing, so take them out of one of the lists"
            )
        there = set(recording.keys)
        sides = tuple(sorted(there.intersection(train))), tuple(sorted(there.intersection(val)))
        if not all(sides):
            raise ConfigError(f"{source}: names no frame of {recording.path} to {'try' if sides[0] else 'learn from'}")
        return FrameSplit(*sides, str(source), len({*train, *val}), sum(map(len, sides)))
    if len(recording) == 1:
        return FrameSplit(recording.keys, recording.keys, "one frame alone, learnt from and tried")
    drawn = _drawn(recording.keys, max(round(TRAIN_SHARE * len(recording)), 1), seed)
    others = tuple(sorted(set(recording.keys).difference(drawn)))
    return FrameSplit(drawn, others, f"no lists there: by chance, seed {seed}")


def classes_there(recording: Recording) -> frozenset[str]:
    """The classes of the labels that lie beside a KITTI recording, whatever their size and however hidden.

    Raises:
        FormatError: labels that cannot be read.
    """
    found: set[str] = set()
    for key in recording.keys:
        file = label_file(recording, key)
        if file is None or not file.is_file():
            continue
        if recording.format == TRACKING:
            # one file has all frames
            tracks = read_tracking_labels(file, None)
            return frozenset(truth.label for k in recording.keys for truth in tracks.get(frame_number(file, k), ()))
        found.update(row.label for row in read_kitti_file(file, scored=False))
    return frozenset(found)


def link_frames(recording: Recording, keys: Sequence[str], folder: Path) -> None:
    """A folder with links to these frames' files, in the recording's own layout; complete, or not at all.

    Raises:
        FormatError: it cannot be made.
    """
    folders, files = LAYOUTS[recording.format]
    with new_folder(folder, lambda _: True) as out:
        if isinstance(recording, SunRgbdScenes):
            scenes = dict(zip(recording.keys, recording.scenes, strict=True))
            _link(folder, ((scenes[key], out / key) for key in keys))
            return
        wanted = set(keys)
        for name in folders:
            source = recording.root / name
            if source.is_dir():
                (out / name).mkdir()
                paths = (path for path in sorted(source.iterdir()) if path.stem in wanted)
                _link(folder, ((path, out / name / path.name) for path in paths))
        _link(folder, ((recording.root / name, out / name) for name in files if (recording.root / name).is_file()))


def _link(folder: Path, pairs: Iterable[tuple[Path, Path]]) -> None:
    try:
        for source, link in pairs:
            link.symlink_to(source.resolve())
    except OSError as error:
        raise FormatError(folder, f"links to the frames cannot be made ({error.strerror})") from error


def _drawn(keys: Sequence[str], number: int, seed: int) -> tuple[str, ...]:
    if number >= len(keys):
        return tuple(keys)
    return tuple(sorted(key for _, key in share_of([("", key) for key in keys], number / len(keys), seed)))


def _own_lists(recording: Recording) -> tuple[Path, list[str], list[str]] | None:
    """The file that names the frames to learn from, those frames, and those to try."""
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
    """Keys from the toolbox's cell arrays `alltrain` and `alltest`, whose paths lead through a folder SUNRGBD.

    Raises:
        FormatError: not such a file.
    """
    try:
        train, test = (read_mat(path, name, MOST_LIST_BYTES) for name in ("alltrain", "alltest"))
    except (OSError, MatFileError) as error:
        raise FormatError(path, f"the list of scenes cannot be read ({error})") from error
    if not isinstance(train, list) or not isinstance(test, list):
        raise FormatError(path, "alltrain and alltest are no lists of scenes")
    return [_scene_key(str(scene)) for scene in train], [_scene_key(str(scene)) for scene in test]


def _scene_key(path: str) -> str:
    return path.replace("\\", "/").partition("SUNRGBD/")[2].strip("/").replace("/", "__")
