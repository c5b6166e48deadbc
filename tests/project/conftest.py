"""Fixtures: a new project with one recording, and a project that has all that a backup can hold."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from store_samples import by_hand, by_machine, proposal_at, some_boxes

from annotator.project import Project, StoredRecording, create_project
from annotator.types import BoxKind, DetectorKind


@pytest.fixture
def project(tmp_path: Path) -> Iterator[Project]:
    with create_project(tmp_path, "hands", ("hand", "person")) as project:
        yield project


@pytest.fixture
def recording(project: Project, tmp_path: Path) -> StoredRecording:
    """Five frames, "0" to "4"."""
    return project.recordings.add(tmp_path / "take", "rgbd", "take", [str(n) for n in range(5)], True)


@pytest.fixture
def frame(project: Project, recording: StoredRecording) -> int:
    """The id of an unlabelled frame."""
    return project.frames.find(recording.id, "2").id


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A closed project with labels, boxes, a view, and two detectors of which one is active; do not change it."""
    root = tmp_path_factory.mktemp("template")
    with create_project(root, "hands", ("hand", "person")) as project:
        project.recordings.add(root / "take", "rgbd", "take", [str(n) for n in range(5)], True)
        frames = [frame.id for frame in project.frames.of()]
        project.proposals.replace(frames[0], [proposal_at(0.0), proposal_at(5.0)], by_machine())
        project.labels.accept(frames[0], project.labels.of_frame(frames[0])[0].uid, by_hand(1))
        project.boxes.set_on_image(frames[1], some_boxes(2), BoxKind.BOX, by_hand())
        view = project.views.store(np.zeros((4, 4, 3), np.uint8))
        project.boxes.set_on_view(view, some_boxes(1), BoxKind.BOX, by_hand(1), frame_id=frames[1])
        project.frames.finalise(frames[2], by_hand())
        for name in ("one", "two"):
            run = project.models_folder / "image" / name
            for part in ("validation", "detector-openvino-0123abcd"):
                (run / part).mkdir(parents=True)
                (run / part / "0.jpg").write_bytes(b"jpg")
            weights = run / "detector.safetensors"
            weights.write_bytes(name.encode())
            (run / "model.json").write_text("{}")
            project.models.register(
                DetectorKind.IMAGE, weights, labels=["hand"], box_kind=BoxKind.BOX, metrics={}, fingerprint=name
            )
    return root / "hands"


@pytest.fixture
def full(template: Path, tmp_path: Path) -> Path:
    """A copy of the template that a test may change."""
    return Path(shutil.copytree(template, tmp_path / "hands"))
