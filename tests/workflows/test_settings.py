"""Settings of the recursion, sizes from reviewed boxes; errors of missing and unusable detectors."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.cli.main import main
from annotator.project import BoxRotation, NewLabel, Project, ProjectSettings, WriteContext, create_project
from annotator.project.classes import edit
from annotator.rcv.config import RcvConfig, Strategy, typical_size
from annotator.rcv.starts import is_warm
from annotator.recordings import open_recording
from annotator.types import BoxKind, DetectorKind, OrientedBox, ReviewState
from annotator.types.errors import AnnotatorError, ConfigError, DetectionError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import Detectors, active_detectors, load_detector, required_model
from annotator.workflows.settings import editable, rcv_config, reviewed_sizes
from annotator.workflows.training import train
from annotator.workflows.warm_up import warm_up


@pytest.fixture
def project(tmp_path: Path) -> Iterator[Project]:
    with create_project(tmp_path, "p", ("thing",)) as created:
        yield created


def keep(project: Project, **rcv: object) -> None:
    project.configure(settings=ProjectSettings.model_validate({"rcv": rcv}))


def written(folder: Path, content: object) -> Path:
    path = folder / "settings.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_each_source_overrides_the_ones_below(project: Project, tmp_path: Path) -> None:
    keep(project, max_steps=7, min_view_score=0.1, coarse_box=True, view_px=96)
    assert rcv_config(project).max_steps == 7
    file = written(tmp_path, {"min_view_score": 0.2, "coarse_box": False, "strategy": "normals"})
    config = rcv_config(project, file, {"strategy": "camera"})
    assert config == RcvConfig(max_steps=7, min_view_score=0.2, view_px=96, strategy=Strategy.CAMERA)


def test_shown_settings_can_be_used_as_a_settings_file(project: Project, tmp_path: Path) -> None:
    keep(project, max_steps=7, coarse_box=True)
    shown = editable(rcv_config(project))
    assert json.loads(shown)["view_px"] == RcvConfig().view_px
    keep(project)
    assert rcv_config(project, written(tmp_path, shown)) == RcvConfig(max_steps=7, coarse_box=True)


def test_only_changed_settings_are_stored(project: Project) -> None:
    keep(project, max_steps=7)
    assert json.loads((project.path / "project.json").read_text())["settings"]["rcv"] == {"max_steps": 7}


TYPICAL = {"label": "thing", "size_m": [3.0, 2.0, 1.0], "spread": [0.1, 0.1, 0.1]}
WRONG = [
    ({"max_step": 3}, "max_step: there is no such setting; did you mean 'max_steps'?"),
    (
        {"typical_sizes": [TYPICAL | {"sprad": 1}]},
        "typical_sizes.0.sprad: there is no such setting; did you mean 'spre",
    ),
    ({"view_px": 9999}, "view_px: must be less than or equal to 2048, not 9999"),
    ({"strategy": "magic"}, "strategy: must be 'camera', 'eigenvectors', 'normals' or 'consensus', not 'magic'"),
    ({"orientation": "free"}, "orientation: cannot be set: it follows from the rotation"),
]


@pytest.mark.parametrize(("settings", "says"), WRONG, ids=[json.dumps(settings) for settings, _ in WRONG])
def test_errors_name_the_file_and_field(
    project: Project, tmp_path: Path, settings: dict[str, object], says: str
) -> None:
    file = written(tmp_path, settings)
    with pytest.raises(ConfigError) as caught:
        rcv_config(project, file)
    assert str(caught.value).startswith(f"{file}: {says}")
    keep(project, **settings)
    with pytest.raises(ConfigError) as caught:
        rcv_config(project)
    assert str(caught.value).startswith(f"{project.path / 'project.json'}: settings.rcv.{says}")


@pytest.mark.parametrize(
    "content",
    ["", "[1]", '{"min_view_score": NaN}', '{"a":' * 5000],
    ids=["empty", "list", "nan", "deep"],
)
def test_an_invalid_settings_file_is_refused(project: Project, tmp_path: Path, content: str) -> None:
    file = written(tmp_path, content)
    with pytest.raises(AnnotatorError, match=r"settings\.json"):
        rcv_config(project, file)
    with pytest.raises(AnnotatorError, match=r"missing\.json"):
        rcv_config(project, tmp_path / "missing.json")


def test_show_config_prints_the_resulting_settings(
    project: Project, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keep(project, max_steps=7)
    file = written(tmp_path, {"min_view_score": 0.2})
    words = ["annotate", "p", "--projects", str(tmp_path), "--config", str(file), "--axes", "normals", "--show-config"]
    assert main(words) == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["max_steps"], shown["min_view_score"], shown["strategy"]) == (7, 0.2, "normals")
    derived = {"orientation", "box_kind", "class_agnostic", "trained", "image_box_kind", "reviewed_sizes"}
    assert shown.keys() == RcvConfig.model_fields.keys() - derived


def run(project: Project, *words: str) -> int:
    return main([words[0], project.config.name, *words[1:], "--projects", str(project.path.parent)])


def test_simulate_views_train_and_annotate_use_the_projects_settings(
    people: Project, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    keep(people, view_px=64, max_steps=1)
    taught: list[RcvConfig] = []
    monkeypatch.setattr(train, "view_samples", lambda _, __, rcv, *rest: taught.append(rcv) or iter(()))
    monkeypatch.setattr("annotator.cli.annotate.trained_detectors", lambda *_: knowing("people"))
    (recording,) = people.recordings.all()
    assert run(people, "simulate", recording.name, "--every", "5") == 0
    assert {max(people.views.load(v.view_id).shape[:2]) for v in people.boxes.on_views()} == {64}
    assert run(people, "views", str(tmp_path / "out")) == 0
    assert {max(cv2.imread(str(path)).shape[:2]) for path in (tmp_path / "out").glob("*.png")} == {64}
    assert run(people, "train", "--only", "view") == 2  # no samples, so training fails
    assert taught == [RcvConfig(max_steps=1, view_px=64)]
    assert run(people, "annotate", "--limit", "1") == 0
    kept = json.loads(people.jobs.all()[-1].config)
    assert (kept["max_steps"], kept["view_px"]) == (1, 64)


def test_pseudo_views_have_the_detectors_training_size_unless_set(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = project.models_folder / "detector.pt"
    weights.write_bytes(b"weights")
    assert rcv_config(project) == RcvConfig()
    assert rcv_config(project, view_px=96).view_px == 96
    project.models.register(
        DetectorKind.VIEW, weights, labels=["hand"], box_kind=BoxKind.BOX, metrics={}, fingerprint="of the weights"
    )
    monkeypatch.setattr("annotator.workflows.settings.read_trained", lambda folder: SimpleNamespace(image_size_px=320))
    assert rcv_config(project).view_px == 320
    # a new training uses its own size
    assert rcv_config(project, view_px=96).view_px == 96
    assert rcv_config(project, options={"view_px": 64}, view_px=96).view_px == 64
    monkeypatch.undo()
    # an unreadable model is ignored here; running it raises the error
    assert rcv_config(project).view_px == RcvConfig().view_px


ABOUT_Z = Rotation.from_euler("z", 0.4).as_matrix()


@pytest.fixture
def sized(tmp_path: Path, generated: Path) -> Iterator[Project]:
    with create_project(tmp_path, "p", ("thing", "Car", "other")) as created:
        register_recording(created, open_recording(generated / "people"))
        yield created


def add(
    sized: Project,
    frame: int,
    size_m: tuple[float, float, float],
    rotation: np.ndarray = ABOUT_Z,
    label: str = "thing",
    kind: BoxKind = BoxKind.BOX,
    track: int | None = None,
    state: ReviewState = ReviewState.ACCEPTED,
) -> None:
    stored = sized.frames.of()[frame]
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), rotation, np.array(size_m))
    new = NewLabel(label, box, box_kind=kind, state=state, track_id=track)
    sized.labels.create(stored.id, [new], WriteContext(stored.revision, "ann"))


def test_without_reviewed_boxes_there_are_no_sizes(sized: Project) -> None:
    add(sized, 0, (2.0, 1.0, 0.5), state=ReviewState.REJECTED)
    add(sized, 1, (2.0, 1.0, 0.5), kind=BoxKind.SILHOUETTE)
    assert reviewed_sizes(sized) == ()


def test_the_first_box_gives_the_size_and_further_ones_make_it_sure(sized: Project) -> None:
    add(sized, 0, (1.0, 2.0, 0.5))
    (one,) = reviewed_sizes(sized)
    assert one.label == "thing"
    assert one.size_m == pytest.approx((2.0, 1.0, 0.5))  # upright: the longer of length and width first
    for frame in (1, 2, 3):
        add(sized, frame, (2.0, 1.0, 0.5))
    (four,) = reviewed_sizes(sized)
    assert four.size_m == pytest.approx((2.0, 1.0, 0.5))
    assert max(four.spread) < min(one.spread) < 0.2
    assert rcv_config(sized).reviewed_sizes == (four,)


def test_boxes_of_unlike_sizes_have_a_wide_spread(sized: Project) -> None:
    for frame, factor in enumerate((0.5, 1.0, 2.0)):
        add(sized, frame, (2.0 * factor, 1.0, 0.5))
    (size,) = reviewed_sizes(sized)
    assert size.size_m == pytest.approx((2.0, 1.0, 0.5))
    assert size.spread[0] > 0.4 > 0.15 > size.spread[2]


def test_some_frames_do_not_count(sized: Project) -> None:
    add(sized, 0, (2.0, 1.0, 0.5))
    add(sized, 1, (8.0, 1.0, 0.5))
    held_out = sized.frames.of()[1].id
    (size,) = reviewed_sizes(sized, [held_out])
    assert size.size_m[0] == pytest.approx(2.0)
    assert rcv_config(sized, without_frames=[held_out]).reviewed_sizes == (size,)


def test_free_boxes_are_compared_in_the_order_in_which_they_are_most_alike(sized: Project) -> None:
    add(sized, 0, (2.0, 1.0, 0.5))
    add(sized, 1, (1.0, 0.5, 2.0), Rotation.from_euler("x", 1.2).as_matrix())
    (size,) = reviewed_sizes(sized)
    assert sorted(size.size_m) == pytest.approx([0.5, 1.0, 2.0])
    assert max(size.spread) < 0.2


def test_upright_boxes_keep_their_height_however_the_camera_is_tilted(sized: Project) -> None:
    for frame, tilt in enumerate((0.0, 0.3, 0.6)):
        add(sized, frame, (0.5, 0.3, 1.6 + 0.05 * frame), Rotation.from_euler("x", tilt).as_matrix())
    (size,) = reviewed_sizes(sized)
    assert size.size_m == pytest.approx((0.5, 0.3, 1.65), rel=0.01)


def test_boxes_of_free_projects_are_like_those_of_a_well_known_class(tmp_path: Path, generated: Path) -> None:
    settings = ProjectSettings(rotation=BoxRotation.FREE)
    known = typical_size("pedestrian")
    assert known is not None
    length, width, height = known.size_m
    with create_project(tmp_path, "free", ("pedestrian",), settings=settings) as sized:
        register_recording(sized, open_recording(generated / "hands"))
        add(sized, 0, (height, length, width), label="pedestrian")
        (size,) = reviewed_sizes(sized)
        assert size.size_m == pytest.approx(known.size_m)


def test_a_well_known_class_begins_with_its_size(sized: Project) -> None:
    known = typical_size("Car")
    assert known is not None
    add(sized, 0, (4.6, 1.7, 1.5), label="Car")
    (size,) = reviewed_sizes(sized)
    assert known.size_m[0] < size.size_m[0] < 4.6


def test_toy_cars_are_no_cars(sized: Project) -> None:
    add(sized, 0, (0.08, 0.04, 0.03), label="Car")
    (size,) = reviewed_sizes(sized)
    assert size.size_m == pytest.approx((0.08, 0.04, 0.03))


def test_a_track_counts_once(sized: Project) -> None:
    for frame in range(3):
        add(sized, frame, (2.0, 1.0, 0.5), track=7)
    add(sized, 3, (1.0, 1.0, 0.5), track=8)
    (size,) = reviewed_sizes(sized)
    assert size.size_m[0] == pytest.approx(np.sqrt(2.0))


def test_sizes_of_the_settings_come_first(sized: Project) -> None:
    add(sized, 0, (2.0, 1.0, 0.5))
    own = {"label": "thing", "size_m": [3.0, 2.0, 1.0], "spread": [0.1, 0.1, 0.1]}
    sized.configure(settings=ProjectSettings.model_validate({"rcv": {"typical_sizes": [own]}}))
    config = rcv_config(sized).for_detector(BoxKind.BOX, class_agnostic=True)
    size = config.typical_size("thing")
    assert size is not None and size.size_m == (3.0, 2.0, 1.0)
    assert json.loads(editable(config))["typical_sizes"] == [own]
    assert "reviewed_sizes" not in editable(config)


def register(project: Project, role: DetectorKind, content: bytes = b"no weights") -> Path:
    weights = project.models_folder / role.value / "run" / "detector.pt"
    weights.parent.mkdir(parents=True)
    weights.write_bytes(content)
    project.models.register(role, weights, labels=["person"], box_kind=BoxKind.BOX, metrics={}, fingerprint=role.value)
    return weights


def test_without_trained_detectors_the_error_names_the_command(people: Project) -> None:
    with pytest.raises(DetectionError, match="has no image detector yet; run `annotator train project0`"):
        active_detectors(people)
    register(people, DetectorKind.IMAGE)
    with pytest.raises(DetectionError, match="has no view detector yet"):
        active_detectors(people)


def test_weights_without_their_record_are_an_error(people: Project) -> None:
    for role in DetectorKind:
        register(people, role)
    with pytest.raises(AnnotatorError, match=r"model\.json: no such file"):
        active_detectors(people)


@pytest.mark.parametrize(("name", "value"), [("image_size_px", 7), ("threads", 0)])
def test_a_setting_out_of_range_is_named(tmp_path: Path, name: str, value: object) -> None:
    settings: dict[str, Any] = {"image_size_px": 96, name: value}
    with pytest.raises(ConfigError, match=f"detector setting {name}: .*, not {value!r}"):
        load_detector(tmp_path / "detector.pt", **settings)


def test_a_detector_follows_classes_that_were_changed_after_its_training(people: Project) -> None:
    register(people, DetectorKind.IMAGE)
    assert required_model(people, DetectorKind.IMAGE).names == ()
    people.change_classes(edit.RenameClass(name="person", new="human"), "ann")
    people.change_classes(edit.RenameClass(name="human", new="adult"), "ann")
    assert required_model(people, DetectorKind.IMAGE).names == (("person", "adult"),)
    people.change_classes(edit.AddClass(name="child"), "ann")
    people.change_classes(edit.RemoveClass(name="adult", with_boxes=True), "ann")
    assert required_model(people, DetectorKind.IMAGE).names == (("person", None),)


def test_objects_are_found_in_all_ways() -> None:
    found = [[is_warm(proposal) for proposal in result.proposals] for result in warm_up()]
    by_classes, class_agnostic = found[:4], found[4:]
    assert by_classes == [[False], [True]] * 2
    assert class_agnostic == [[False]] * 4
