"""The interface of recordings, a list of frames that are read one at a time, and the options of their readers.

Errors of all readers: a RecordingError when one is opened (ConfigError for its options, MissingExtraError without its
library), a FrameError when a frame is read, an IndexError where there is no such frame.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from jaxtyping import UInt8
from pydantic import Field, ValidationError
from scipy.spatial.transform import RigidTransform

from annotator.types import Frame
from annotator.types.bases import Strict
from annotator.types.boxes import FARTHEST_M
from annotator.types.errors import ConfigError

Place = tuple[Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)], ...]


class ReaderOptions(Strict):
    """How a recording is read; None = the reader decides. `annotator.recordings.open.READERS` says who takes what.

    The descriptions are the help texts of the command line.
    """

    columns: int | None = Field(None, ge=3, le=64, description="numbers per point in .bin files")
    scene: str | None = Field(None, min_length=1, description="scenes of a dataset; all = all of them")
    camera: str | None = Field(None, min_length=1, description="cameras of a rig; all = all of them")
    look_around: Literal[4, 6, 8] | None = Field(
        None, description="number of virtual cameras around a LiDAR, to label all that it sees"
    )
    origin: Place | None = Field(
        None,
        min_length=3,
        max_length=3,
        description="place of the virtual camera in clouds with map coordinates, metres; by default their middle",
    )
    image: str | None = Field(None, min_length=1, description="topic of the camera images in a bag")
    points: str | None = Field(None, min_length=1, description="topic of the point clouds in a bag")
    depth: str | None = Field(None, min_length=1, description="topic of the depth images in a bag")
    camera_info: str | None = Field(None, min_length=1, description="topic of the camera's calibration in a bag")
    depth_info: str | None = Field(None, min_length=1, description="topic of the depth camera's calibration in a bag")
    tf_frame: str | None = Field(
        None, min_length=1, description="tf frame of the camera, if not the one that its images name"
    )
    no_motion: Literal[True] | None = Field(
        None, description="do not move a bag's clouds to the images' times, even if tf knows how the rig moved"
    )
    tolerance_s: float | None = Field(
        None, gt=0, le=10, description="largest difference in time between an image and its points or depth, seconds"
    )
    min_confidence: int | None = Field(
        None, ge=0, le=2, description="lowest confidence of a phone's depth that is used: 0, 1 or 2"
    )

    def given(self) -> dict[str, Any]:
        return self.model_dump(exclude_none=True)

    def may_be(self, stored: ReaderOptions) -> bool:
        """True if a recording that is stored with other options is read with these: an origin may have been found."""
        return self == (stored.model_copy(update={"origin": None}) if self.origin is None else stored)

    def stored(self) -> str:
        """The options as a project stores them: JSON, or "" if none is set."""
        return self.model_dump_json(exclude_none=True) if self.given() else ""


def parse_options(**given: Any) -> ReaderOptions:
    """Options by name, such as those of a command; None = not given."""
    try:
        return ReaderOptions(**given)
    except ValidationError as error:
        problem = error.errors()[0]
        name = "_".join(map(str, problem["loc"]))
        raise ConfigError(f"{option_flag(name)} {problem.get('input')}: {problem['msg']}") from error


def stored_options(text: str) -> ReaderOptions:
    """Options from a project; "" = none."""
    try:
        return ReaderOptions.model_validate_json(text) if text else ReaderOptions()
    except ValidationError as error:
        raise ConfigError(
            f"the stored reader options {text} are not known to this version: update annotator"
        ) from error


def option_flag(name: str) -> str:
    """The flag of an option on the command line."""
    return {"tf_frame": "--frame", "tolerance_s": "--tolerance"}.get(name, "--" + name.replace("_", "-"))


@dataclass(frozen=True, eq=False)
class Recording(ABC):
    """A folder or file of frames. Opening it lists the frames; `frame` reads one without caching it.

    Attributes:
        path: the path that was opened, as given.
        keys: the frames' names, unique and stable, in order.
        format: the reader's name in `annotator.recordings.open`.
        is_sequence: True if the frames are in time order.
        is_parallel: several threads may call `frame` at the same time.
    """

    path: Path
    keys: tuple[str, ...]
    format: ClassVar[str]
    is_sequence: ClassVar[bool]
    is_parallel: ClassVar[bool] = False

    @abstractmethod
    def frame(self, i: int) -> Frame:
        """Reads frame number `i`, 0-based.

        Raises:
            FrameError: this frame cannot be read; others may be readable.
            IndexError: there is no such frame.
        """

    def image(self, i: int) -> UInt8[np.ndarray, "h w 3"]:
        """Reads the image of frame `i`, RGB order: without the rest of the frame, if it is a file of its own."""
        return self.frame(i).rgb

    @property
    def root(self) -> Path:
        """The folder of the frames (and labels): `path`, or its `training` subfolder."""
        return self.path

    @property
    def name(self) -> str:
        """A short name to display: that of the folder or file."""
        path = self.path.resolve()
        return path.stem if path.is_file() else path.name

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know about how it is read, such as images without a cloud; one sentence each."""
        return ()

    @property
    def origin(self) -> Place | None:
        """The origin in map coordinates; None in a sensor's coordinates, or with a real camera. It may read a cloud."""
        return None

    @property
    def pose_source(self) -> str | None:
        """The file or topic of the frames' poses; None without poses, and where only the clouds are in a map."""
        return None

    def pose(self, i: int) -> RigidTransform | None:
        """Returns `T_world_camera` of frame `i` at its time, as in `Frame`; None if it is not known.

        It reads a cloud only if that says where the virtual camera stands.
        """
        self.key(i)
        return None

    @cached_property
    def indices(self) -> dict[str, int]:
        return {key: i for i, key in enumerate(self.keys)}

    def __len__(self) -> int:
        return len(self.keys)

    def files(self, i: int) -> tuple[Path, ...]:
        """Returns the files that only frame `i` is read from, as far as the reader knows them."""
        self.key(i)
        return ()

    def key(self, i: int) -> str:
        """Returns the key of frame `i`; unlike `keys[i]`, it raises for negative indices."""
        if not 0 <= i < len(self.keys):
            raise IndexError(f"frame {i} of a recording with {len(self.keys)} frames")
        return self.keys[i]
