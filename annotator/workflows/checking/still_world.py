"""Checks the poses of a recording: what stands still must do so in all frames.

Pairs of frames are brought into one world by their poses, and the later cloud is then registered with the earlier one.
How far that moves its points is how far a wall moves between the frames. Where it moves, the usual mistakes are tried:
a pose that stands still by one of them says which.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.normals import normals_knn
from annotator.geometry.projection import every_nth
from annotator.geometry.registration import register_surface
from annotator.recordings import Recording
from annotator.types import Frame
from annotator.types.errors import RecordingError
from annotator.types.messages import amount

# Pairs of frames that are compared, and how many must be comparable for a result.
PAIRS, LEAST_PAIRS = 12, 2
# The later frame of a pair is the first one from which the camera has moved so far, or the last of these.
MOVED_M, MOVED_RAD, MOST_APART = 0.15, np.radians(4), 10
# Points of the earlier frame, and of the later one.
POINTS, MOVED_POINTS, NEIGHBOURS = 12_000, 1_500, 12
# How far a point may be from its counterpart, share of the clouds' median distance, and its limits, metres.
REACH, REACHES_M = 0.1, (0.2, 2.0)
# A wall moves if it does so by more than this, metres and share of the median distance.
STILL_M, STILL = 0.03, 0.01
# A mistake explains it if the wall moves by this share of that, and stands still.
EXPLAINS = 0.5


@dataclass(frozen=True, eq=False)
class Seen:
    """A frame's points, in its camera's frame."""

    xyz_m: Float64[np.ndarray, "n 3"]

    @cached_property
    def distance_m(self) -> float:
        return float(np.median(np.linalg.norm(self.xyz_m, axis=1)))

    @cached_property
    def surface(self) -> tuple[KDTree, Float32[np.ndarray, "n 3"]]:
        return KDTree(self.xyz_m), normals_knn(self.xyz_m, NEIGHBOURS)


def _seen(frame: Frame) -> Seen:
    return Seen(every_nth(frame.cloud.xyz_m, POINTS).astype(np.float64))


def off_m(first: Seen, second: Seen, T_first_second: RigidTransform) -> float:
    """Returns how far the points of one frame must be moved to lie on those of an earlier one, median, metres.

    Infinite if they cannot be registered: too few are near each other.
    """
    reach_m = float(np.clip(REACH * first.distance_m, *REACHES_M))
    points = every_nth(second.xyz_m, MOVED_POINTS)
    start = T_first_second.rotation.as_matrix(), T_first_second.translation
    found = register_surface(points, *first.surface, start, reach_m)
    if found is None:
        return np.inf
    moved = points @ (found[0] - start[0]).T + found[1] - start[1]
    return float(np.median(np.linalg.norm(moved, axis=1)))


Step = Callable[[RigidTransform, RigidTransform], RigidTransform]


def said(first: RigidTransform, second: RigidTransform) -> RigidTransform:
    """Returns the step from the second to the first frame."""
    return first.inv() * second


def _in_axes(matrix: list[list[int]]) -> Step:
    """Returns the step between poses of a frame with other axes, whose rows are those of the camera."""
    T = RigidTransform.from_rotation(Rotation.from_matrix(np.array(matrix, float)))
    return lambda first, second: T * first.inv() * second * T.inv()


# Mistakes, and the step between two poses without them.
MISTAKES: dict[str, Step] = {
    "the clouds are in one world already, so they need no poses": lambda first, second: RigidTransform.identity(),
    "the poses lead from the world to the sensor; write their inverse": lambda first, second: first * second.inv(),
    "the poses have OpenGL's axes (x right, y up, z backward)": _in_axes([[1, 0, 0], [0, -1, 0], [0, 0, -1]]),
    "the poses have a vehicle's axes (x ahead, y left, z up)": _in_axes([[0, -1, 0], [0, 0, -1], [1, 0, 0]]),
}
# Pairs of frames for which they are tried.
TRIED = 5
# Frames by which the poses may be too early or too late.
LATE = (-2, -1, 1, 2)


@dataclass
class StillWorld:
    """Compares frames of a recording that are added in their order."""

    recording: Recording
    poses: dict[int, RigidTransform] = field(init=False)
    pairs: dict[int, int] = field(init=False)
    kept: dict[int, Seen] = field(default_factory=dict)
    found: list[tuple[int, int, Seen, Seen, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.poses, self.pairs = {}, {}
        count = len(self.recording) if self.recording.pose_source is not None and self.recording.is_sequence else 0
        for i in np.unique(np.linspace(0, count - 1, min(count, PAIRS)).astype(int)).tolist():
            later = next((j for j in range(i + 1, min(i + MOST_APART + 1, count)) if self._moved(i, j)), None)
            if later is not None and self._pose(i) is not None and self._pose(later) is not None:
                self.pairs[i] = later

    def _pose(self, i: int) -> RigidTransform | None:
        if i not in self.poses and 0 <= i < len(self.recording):
            try:
                pose = self.recording.pose(i)
            except RecordingError:  # the frame reports it
                pose = None
            if pose is not None:
                self.poses[i] = pose
        return self.poses.get(i)

    def _moved(self, i: int, j: int) -> bool:
        """True if the camera has moved far enough, or frame `j` is the last one that is compared with frame `i`."""
        first, second = self._pose(i), self._pose(j)
        if first is None or second is None or j in (i + MOST_APART, len(self.recording) - 1):
            return True
        step = said(first, second)
        return bool(np.linalg.norm(step.translation) >= MOVED_M or step.rotation.magnitude() >= MOVED_RAD)

    def add(self, index: int, frame: Frame) -> None:
        """Compares a frame with those before that wait for it."""
        for first in [i for i, later in self.pairs.items() if later == index and i in self.kept]:
            one, other = self.kept[first], _seen(frame)
            off = off_m(one, other, said(self.poses[first], self.poses[index]))
            self.found.append((first, index, one, other, off))
        self.kept = {i: each for i, each in self.kept.items() if self.pairs[i] > index}
        if index in self.pairs:
            self.kept[index] = _seen(frame)

    def problem(self) -> str | None:
        """Returns how far what stands still moves, and why; None if it stands still, or nothing can be said."""
        offs = [off for *_, off in self.found]
        if len(offs) < LEAST_PAIRS:
            return None
        moves_m, distance_m = float(np.median(offs)), float(np.median([one.distance_m for _, _, one, *_ in self.found]))
        if moves_m <= STILL_M + STILL * distance_m:
            return None
        how = f"by {moves_m:.2f} m" if np.isfinite(moves_m) else "out of reach"
        text = f"what stands still moves {how} between frames, by the poses in {self.recording.pose_source}"
        best, why = min(((self._with(step), why) for step, why in self._mistakes()), key=lambda each: each[0])
        if best <= min(EXPLAINS * moves_m, STILL_M + STILL * distance_m):
            return f"{text}; it stands still if {why}"
        return text

    def _mistakes(self) -> Iterator[tuple[Callable[[int, int], RigidTransform | None], str]]:
        for why, mistake in MISTAKES.items():
            yield partial(self._step, mistake, 0), why
        for late in LATE:
            which = f"the frame {amount(abs(late), 'place')} {'after' if late > 0 else 'before'} it"
            yield partial(self._step, said, late), f"each frame has the pose of {which}: two clocks"

    def _step(self, step: Step, late: int, i: int, j: int) -> RigidTransform | None:
        first, second = self._pose(i + late), self._pose(j + late)
        return None if first is None or second is None else step(first, second)

    def _with(self, step: Callable[[int, int], RigidTransform | None]) -> float:
        """Returns how far what stands still moves by other steps between the frames, median, metres."""
        steps = [(one, other, step(i, j)) for i, j, one, other, _ in self.found[:: len(self.found) // TRIED + 1]]
        offs = [off_m(one, other, T) for one, other, T in steps if T is not None]
        return float(np.median(offs)) if len(offs) >= LEAST_PAIRS else np.inf
