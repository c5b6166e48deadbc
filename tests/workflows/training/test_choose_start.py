"""A training starts from the best detector on held-out frames that does not know them."""

from __future__ import annotations

import pytest
from view_detectors import CONFIG, HELD_OUT, PLAN, Fixed, held, install_base, register, write_model

from annotator.detection import pretrained
from annotator.project import Project
from annotator.rcv.config import RcvConfig
from annotator.types import BoxKind, DetectorKind
from annotator.workflows.detectors import AGNOSTIC, UsedModel, base_model, load_detector, own_model
from annotator.workflows.training import held_out, run
from annotator.workflows.training.agnostic_samples import agnostic_samples
from annotator.workflows.training.held_out import HeldOut
from annotator.workflows.training.rounds import choose_start
from annotator.workflows.training.samples import gather


def test_a_training_starts_from_the_best_detector_on_held_out_frames(labelled: Project, ious: dict[str, float]) -> None:
    measured = held(labelled)
    assert choose_start(labelled, measured, CONFIG).model is None
    install_base()
    ious["base detector"] = 0.5
    assert choose_start(labelled, measured, CONFIG).model == base_model()
    active, newest = register(labelled, "a", active=True), register(labelled, "b")
    for a, b, best in ((0.6, 0.4, active), (0.4, 0.6, newest), (0.3, 0.4, None)):
        ious.update(a=a, b=b)
        start = choose_start(labelled, measured, CONFIG)
        assert start.model == (base_model() if best is None else own_model(labelled, best))
        assert sorted(rival.mean_iou for rival in start.compared) == sorted([a, b, 0.5])
    # weights or a network that the settings name come first
    for changes in ({"pretrained": "never"}, {"model": "yolov8n"}, {"image_size_px": 96}):
        assert choose_start(labelled, measured, CONFIG.model_copy(update=changes)).model is None


def test_a_training_takes_the_view_size_of_the_detector_that_it_starts_from(
    labelled: Project, ious: dict[str, float]
) -> None:
    write_model(pretrained.FOLDER, size_px=96)
    ious["base detector"] = 0.5
    start = choose_start(labelled, held(labelled), CONFIG)
    assert (start.model, start.view_px(CONFIG)) == (base_model(), 96)
    assert choose_start(labelled, held(labelled), CONFIG.model_copy(update={"image_size_px": 128})).model is None


def test_a_detector_that_was_trained_on_held_out_frames_is_not_compared(
    labelled: Project, ious: dict[str, float]
) -> None:
    install_base()
    model = register(labelled, "a", active=True)
    manifest = run.Run(labelled, DetectorKind.VIEW, AGNOSTIC, BoxKind.BOX, holds_out=False).write(
        agnostic_samples(labelled, gather(labelled), RcvConfig(), PLAN.samples, Fixed(), lambda *_: None)
    )
    assert {e.group for e in manifest.entries if e.split == "train"} & held_out.held_out_groups(labelled)
    labelled.models.register(
        DetectorKind.VIEW, model.path, labels=AGNOSTIC, box_kind=BoxKind.BOX, metrics={}, fingerprint="a",
        manifest=labelled.models_folder / "view" / "dataset" / "manifest.json",
    )  # fmt: skip
    ious.update({"base detector": 0.2, "a": 0.9})
    assert choose_start(labelled, held(labelled), CONFIG).model == base_model()


@pytest.mark.parametrize("learned", [HELD_OUT[0], None])
@pytest.mark.parametrize("objects", [0, 6])
def test_no_training_starts_from_a_detector_that_may_know_held_out_frames(
    labelled: Project, ious: dict[str, float], learned: str | None, objects: int
) -> None:
    ious["a"] = 0.9
    register(labelled, "a", active=True, learned=learned)
    assert choose_start(labelled, held(labelled, objects), CONFIG).model is None
    # where held-out frames decide nothing, it may
    assert choose_start(labelled, held(labelled, 0), CONFIG, decides=False).model is not None


def test_a_damaged_detector_is_left_out_and_reported(labelled: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    install_base()
    register(labelled, "a", active=True)  # its weights are no weights

    def measure(self: HeldOut, model: UsedModel) -> float:
        return 0.5 if model == base_model() else float(len(load_detector(model.path).labels))

    monkeypatch.setattr(HeldOut, "mean_iou", measure)
    start = choose_start(labelled, held(labelled), CONFIG)
    assert start.model == base_model()
    (line,) = start.left_out
    assert line.startswith("the project's detector a, which cannot be measured: ")
