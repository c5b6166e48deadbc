"""Where the sensor of a recording was: tables of poses in a world that stands still, and what is odd about them.

Each reader gives the table of its format; `Recording.pose` says where a frame's camera was. A table has a row for each
frame, or rows in time that are interpolated: places linearly, rotations along the shortest arc. The world's axes are
those of the files, unless the reader says otherwise. Numbers are doubles, which hold map coordinates (UTM) to a
millionth of a millimetre.

poses.csv               header: key or timestamp_ns, and x y z qw qx qy qz, in any order; metres, a unit quaternion:
                        from the frame of the colour camera, or of the clouds, to the world
trajectory.log          Open3D's: for each frame a line of three numbers and a 4 x 4 matrix, camera to world
camera_trajectory.json  Open3D's PinholeCameraTrajectory: `extrinsic`, world to camera, column by column
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float64, Int64
from pydantic import Field, FiniteFloat
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from annotator.files import TABLE_BYTES, read_file, read_text_file
from annotator.recordings.frame_times import LONGEST_TIME, Times, unit_problem
from annotator.recordings.listing import file_errors
from annotator.recordings.plausible import LARGEST, are_plausible, is_rotation
from annotator.recordings.recording import Recording
from annotator.text import normal, to_number
from annotator.types.bases import FileRecord, Strict
from annotator.types.checks import LATEST_NS, too_late
from annotator.types.errors import RecordingError
from annotator.types.messages import amount, first_few

FILE_NAME = "poses.csv"
OPEN3D_LOGS, OPEN3D_JSONS = ("trajectory.log", "odometry.log"), ("camera_trajectory.json", "trajectory.json")
# Rows further apart are not interpolated: a hand that accelerates by 3 m/s^2 is 2 cm off between them.
LONGEST_GAP_NS = 250_000_000
# Before the first row, after the last one, and beside a gap, a row holds as long: times may be rounded.
HOLDS_NS = 5_000_000
MOST_OFF_UNIT, MOST_OFF_ROTATION = 0.01, 1e-2
REMEDY = "correct the line, or remove the file to use the frames without poses"
MATRIX = (4, 4)


def rigid(place_m: Float64[np.ndarray, "3"], quaternion: Float64[np.ndarray, "4"]) -> RigidTransform:
    """A pose from a place and a quaternion x y z w."""
    return RigidTransform.from_components(place_m, Rotation.from_quat(quaternion))


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses `T_world_sensor` in order; rows of a frame whose pose is not known are NaN.

    Attributes:
        source: the file or topic that has them.
        places_m, quaternions: metres; x y z w.
        times_ns: of the rows, rising; None if there is a row for each frame.
    """

    source: str
    places_m: Float64[np.ndarray, "n 3"] = field(repr=False)
    quaternions: Float64[np.ndarray, "n 4"] = field(repr=False)
    times_ns: Int64[np.ndarray, "n"] | None = field(default=None, repr=False)

    @staticmethod
    def listed(path: Path, rows: Iterable[tuple[int, int, Sequence[float]]]) -> Poses | None:
        """Returns the poses of a file's rows: line, time (ns), x y z and the quaternion x y z w; None without rows.

        Raises:
            RecordingError: a number, a quaternion or the order of the times is wrong; it names the line.
        """
        lines, times, values = list[int](), list[int](), list[Sequence[float]]()
        for line, time_ns, row in rows:
            if times and time_ns <= times[-1]:
                if time_ns == times[-1] and tuple(row) == tuple(values[-1]):
                    continue
                what = "before that of" if time_ns < times[-1] else "that of another pose in"
                raise RecordingError(
                    f"{path}:{line}: its time is {what} line {lines[-1]}: two clocks, or two runs; {REMEDY}"
                )
            lines.append(line)
            times.append(time_ns)
            values.append(row)
        if not times:
            return None
        table = checked(path, lines, values)
        return Poses(path.name, table[:, :3], table[:, 3:], np.array(times, np.int64))

    @staticmethod
    def of_frames(source: str, transforms: Sequence[RigidTransform | None]) -> Poses:
        """Returns a row for each frame; None: not known."""
        nowhere = np.full(7, np.nan)
        rows = [nowhere if T is None else np.r_[T.translation, T.rotation.as_quat()] for T in transforms]
        table = np.array(rows).reshape(-1, 7)
        return Poses(source, table[:, :3], table[:, 3:])

    def at(self, i: int, time_ns: int | None) -> RigidTransform | None:
        """Returns the pose of frame `i` with a time; None where it is not known."""
        if self.times_ns is None:
            return self._row(i) if i < len(self.places_m) else None
        if time_ns is None:
            return None
        after = int(np.searchsorted(self.times_ns, time_ns))
        if 0 < after < len(self.times_ns):
            first, second = self.times_ns[after - 1 : after + 1].tolist()
            if second - first <= LONGEST_GAP_NS:
                return between(self._row(after - 1), self._row(after), (time_ns - first) / (second - first))
        near = min((max(after - 1, 0), min(after, len(self.times_ns) - 1)), key=lambda at: abs(self._from(at, time_ns)))
        return self._row(near) if abs(self._from(near, time_ns)) <= HOLDS_NS else None

    def _from(self, row: int, time_ns: int) -> int:
        assert self.times_ns is not None
        return int(self.times_ns[row]) - time_ns

    def _row(self, row: int) -> RigidTransform | None:
        place_m, quaternion = self.places_m[row], self.quaternions[row]
        return None if np.isnan(place_m[0]) else rigid(place_m, quaternion)


def between(first: RigidTransform | None, second: RigidTransform | None, share: float) -> RigidTransform | None:
    """Returns the pose between two: places linearly, rotations along the shortest arc."""
    if first is None or second is None:
        return None
    turn = Slerp([0, 1], Rotation.concatenate([first.rotation, second.rotation]))(share)
    start = first.translation
    return RigidTransform.from_components(start + (second.translation - start) * share, turn)


def checked(path: Path, lines: Sequence[int], rows: Sequence[Sequence[float]]) -> Float64[np.ndarray, "n 7"]:
    """Returns rows of a place and a quaternion x y z w; RecordingError names the line of the first that has none."""
    table = np.array(rows, np.float64).reshape(-1, 7)
    lengths = np.linalg.norm(table[:, 3:], axis=1)
    # comparisons with NaN are false
    are_sound = np.asarray((np.abs(table) <= LARGEST).all(axis=1))
    for at in np.flatnonzero(~(are_sound & (np.abs(lengths - 1) <= MOST_OFF_UNIT)))[:1]:
        what = f"a unit quaternion, but its length is {lengths[at]:.4g}"
        what = what if are_sound[at] else "a place and a quaternion, of finite numbers"
        raise RecordingError(f"{path}:{lines[at]}: must be {what}; {REMEDY}")
    return table


def pose_of_matrix(path: Path, where: str, values: Sequence[float]) -> RigidTransform:
    """Returns the pose of 12 or 16 numbers, row by row; `where` is the line or entry, such as "line 3"."""
    matrix = np.array([*values, 0, 0, 0, 1][:16], np.float64).reshape(MATRIX)
    if not (are_plausible(matrix) and is_rotation(matrix[:3, :3], MOST_OFF_ROTATION)) or matrix[3].tolist() != [
        0,
        0,
        0,
        1,
    ]:
        raise RecordingError(f"{path}: {where}: is not a rotation and a place (last row 0 0 0 1); {REMEDY}")
    return RigidTransform.from_components(matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3]))


def numbers(path: Path, line: int, words: Sequence[str]) -> list[float]:
    """Returns the words of a line as numbers; RecordingError if one is none."""
    with file_errors(path, REMEDY, f"line {line}: ", RecordingError):
        return [to_number(word) for word in words]


QUATERNION = ("qx", "qy", "qz", "qw")
COLUMNS = ("x", "y", "z", *QUATERNION)


def read_poses(path: Path, keys: Sequence[str], times_ns: Times | None) -> Poses | None:
    """Reads `poses.csv` of a folder; None without the file. Lines of other frames are ignored."""
    file = path / FILE_NAME
    if not file.is_file():
        return None
    with file_errors(file, REMEDY, kind=RecordingError):
        lines = read_text_file(file, TABLE_BYTES)
    try:
        header, *rows = csv.reader(io.StringIO(lines), skipinitialspace=True, strict=True)
    except (csv.Error, ValueError) as error:
        raise RecordingError(f"{file}: is not a table ({error}); {REMEDY}") from error
    names = [name.strip() for name in header]
    by = next((name for name in ("key", "timestamp_ns") if name in names), "")
    if sorted(names) != sorted((by, *COLUMNS)):
        raise RecordingError(
            f"{file}:1: the header must name key or timestamp_ns, and x, y, z, qw, qx, qy, qz, not "
            + ",".join(names)[:80]
        )
    order, at = [names.index(name) for name in COLUMNS], names.index(by)
    found = dict[str, tuple[int, list[float]]]()
    for line, row in enumerate(rows, 2):
        if len(row) != len(names):
            raise RecordingError(f"{file}:{line}: must have {len(names)} values, not {len(row)}; {REMEDY}")
        name = row[at].strip() if by == "timestamp_ns" else normal(row[at])
        if name in found:
            raise RecordingError(f"{file}:{line}: {by} {name[:40]} already has a line; {REMEDY}")
        found[name] = line, numbers(file, line, [row[i] for i in order])
    if by == "key":
        table = checked(file, [line for line, _ in found.values()], [row for _, row in found.values()])
        of_key = dict(zip(found, (rigid(row[:3], row[3:]) for row in table), strict=True))
        return Poses.of_frames(FILE_NAME, [of_key.get(normal(key)) for key in keys])
    if times_ns is None:
        raise RecordingError(f"{file}: has times, but the frames have none; write keys, or timestamps.csv")
    timed = [(line, _whole(file, line, time), row) for time, (line, row) in found.items()]
    if (problem := unit_problem([time for _, time, _ in timed])) is not None:
        raise RecordingError(f"{file}: {problem}; write nanoseconds")
    return Poses.listed(file, timed)


def _whole(path: Path, line: int, text: str) -> int:
    if not text.isdecimal() or len(text) > LONGEST_TIME:
        raise RecordingError(f"{path}:{line}: {text[:40]!r} must be a time in whole nanoseconds; {REMEDY}")
    if int(text) > LATEST_NS:
        raise RecordingError(f"{path}:{line}: {too_late(text, 'ns')}; {REMEDY}")
    return int(text)


Sixteen = Annotated[tuple[FiniteFloat, ...], Field(min_length=16, max_length=16)]


class CameraRecord(FileRecord):
    extrinsic: Sixteen


class TrajectoryFile(FileRecord):
    """Open3D's PinholeCameraTrajectory; `extrinsic` is world to camera, column by column."""

    parameters: tuple[CameraRecord, ...]


def read_open3d(path: Path, count: int) -> tuple[Poses | None, tuple[str, ...]]:
    """Reads the trajectory of Open3D in a folder of `count` frames, a pose for each; None without one. And notes."""
    notes = list[str]()
    for file in (path / name for name in (*OPEN3D_LOGS, *OPEN3D_JSONS)):
        if not file.is_file():
            continue
        poses = _log_poses(file) if file.name in OPEN3D_LOGS else _json_poses(file)
        if poses is None:
            notes.append(f"{file.name} is not a trajectory of Open3D, so it is not used.")
        elif len(poses) == count:
            return Poses.of_frames(file.name, poses), tuple(notes)
        else:
            wrong = f"{file.name} has {amount(len(poses), 'pose')} for {amount(count, 'frame')}, so it is not used"
            return None, (*notes, f"{wrong}; {FILE_NAME} says which pose belongs to which frame.")
    return None, tuple(notes)


def _log_poses(file: Path) -> list[RigidTransform] | None:
    """Returns the poses of a log; None if it does not begin as one: other programs write files of that name, too."""
    with file_errors(file, REMEDY, kind=RecordingError):
        lines = read_text_file(file, TABLE_BYTES).split("\n")
    rows = [(number, line.split()) for number, line in enumerate(lines, 1) if line.strip()]
    if not rows or len(rows[0][1]) != 3 or not all(word.lstrip("-").isdecimal() for word in rows[0][1]):
        return None
    poses = []
    for start in range(0, len(rows), 5):
        (line, head), *matrix = rows[start : start + 5]
        if len(head) != 3 or [len(words) for _, words in matrix] != [4, 4, 4, 4]:
            raise RecordingError(f"{file}:{line}: must be three numbers, and four lines of four numbers; {REMEDY}")
        values = [value for number, words in matrix for value in numbers(file, number, words)]
        poses.append(pose_of_matrix(file, f"line {line}", values))
    return poses


def _json_poses(file: Path) -> list[RigidTransform] | None:
    """As `_log_poses`, of a JSON file."""
    with file_errors(file, REMEDY, "not a trajectory: ", RecordingError):
        data = read_file(file, TABLE_BYTES)
        if b'"extrinsic"' not in data:
            return None
        content = TrajectoryFile.model_validate_json(data)
    columns = (np.reshape(each.extrinsic, MATRIX).T.ravel().tolist() for each in content.parameters)
    return [pose_of_matrix(file, f"pose {number}", each).inv() for number, each in enumerate(columns)]


# A step is a jump if it is this much longer than the steps around it: metres, degrees, and their multiple.
JUMP_M, JUMP_DEG, TIMES_USUAL, AROUND = 0.5, 15.0, 6.0, 5
# Nothing that carries a depth sensor is faster.
FASTEST_M_S = 150.0
MOST_NAMED = 3


class PosesReport(Strict):
    """What the poses of a recording's frames say.

    Attributes:
        source: the file or topic.
        posed: number of frames with a pose.
        way_m: length of the camera's way.
        gaps, jumps: what is missing or implausible; sentences.
    """

    source: str
    frames: int
    posed: int
    way_m: float
    gaps: tuple[str, ...]
    jumps: tuple[str, ...]

    def words(self) -> str:
        """Such as "200 of 200 frames, by poses.csv; a way of 7.52 m"."""
        return f"{self.posed} of {amount(self.frames, 'frame')}, by {self.source}; a way of {self.way_m:.2f} m"


def survey_poses(
    recording: Recording, source: str | None = None, pose: Callable[[int], RigidTransform | None] | None = None
) -> PosesReport | None:
    """Returns what the poses of all frames say: the recording's own, or others by frame; None without poses."""
    source, pose = source or recording.pose_source, pose or recording.pose
    if source is None:
        return None
    poses, broken = dict[int, RigidTransform](), dict[int, str]()
    for i in range(len(recording)):
        try:
            if (known := pose(i)) is not None:
                poses[i] = known
        except RecordingError as error:
            broken[i] = str(error)
    posed = list(poses)
    steps = [poses[i].inv() * poses[j] for i, j in pairwise(posed)]
    lengths_m = np.array([np.linalg.norm(step.translation) for step in steps])
    return PosesReport(
        source=source,
        frames=len(recording),
        posed=len(posed),
        way_m=float(lengths_m.sum()),
        gaps=(*_gaps(recording, {**broken, **poses}, source), *dict.fromkeys(broken.values())),
        jumps=_jumps(recording, posed, lengths_m, np.degrees([step.rotation.magnitude() for step in steps])),
    )


def _gaps(recording: Recording, known: Collection[int], source: str) -> tuple[str, ...]:
    missing = [key for i, key in enumerate(recording.keys) if i not in known]
    if not missing:
        return ()
    if not known and recording.is_sequence:
        advice = "are its times of the frames' clock, and is its sensor calibrated?"
        return (f"{source} has a pose for no frame: {advice}",)
    return (f"{amount(len(missing), 'frame')} without a pose: {first_few(missing, MOST_NAMED)}",)


def _jumps(
    recording: Recording, posed: list[int], lengths_m: Float64[np.ndarray, "n"], turns_deg: Float64[np.ndarray, "n"]
) -> tuple[str, ...]:
    """Returns the steps that are much longer than those around them, and whether all are too fast."""
    if not recording.is_sequence or len(posed) < 2:
        return ()
    apart, jumps = np.diff(posed), list[str]()
    for values, least, form in ((lengths_m, JUMP_M, "{:.2f} m"), (turns_deg, JUMP_DEG, "{:.0f} degrees")):
        each = values / apart
        for at in np.flatnonzero(each > least):
            usual = np.median(each[max(at - AROUND, 0) : at + AROUND + 1])
            if each[at] > least + TIMES_USUAL * usual:
                keys = recording.keys[posed[at]], recording.keys[posed[at + 1]]
                jumps.append(f"a jump by {form.format(values[at])} between the frames {keys[0]} and {keys[1]}")
    times: Times | None = getattr(recording, "times_ns", None)
    known = [] if times is None else [time for i in (posed[0], posed[-1]) if (time := times[i]) is not None]
    if len(known) == 2 and lengths_m.sum() > FASTEST_M_S * (known[1] - known[0]) / 1e9 > 0:
        speed = lengths_m.sum() / (known[1] - known[0]) * 1e9
        jumps.append(f"the camera moves at {speed:,.0f} m/s: are the places in metres?")
    return tuple(jumps)
