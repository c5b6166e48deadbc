"""The whole loop on the command line, with briefly trained detectors."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from annotator.cli.main import main
from annotator.formats.rcv import read_rcv
from annotator.types import Source


@pytest.mark.slow
def test_from_a_recording_to_a_dataset(
    generated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ANNOTATOR_PROJECTS", str(tmp_path / "projects"))
    monkeypatch.chdir(tmp_path)

    def annotator(*words: str | Path) -> str:
        code, printed = main([str(word) for word in words]), capsys.readouterr()
        assert code == 0, printed.err
        return printed.out

    annotator("new", "room", "--classes", "person")
    assert "imported as labels: 15 person in 5 frames" in annotator("add", "room", generated / "people")

    said = annotator(
        *("train", "room", "--epochs", "1", "--image-epochs", "1"),
        *("--size", "64", "--image-size", "64", "--views", "16", "--weights", "never"),
    )
    assert "image detector: trained on" in said
    assert "view detector: trained on" in said
    assert said.count("random weights") == 2
    assert "next: annotator annotate room" in said

    said = annotator("annotate", "room")
    assert said.startswith("5 frames done, ")
    assert ", 0 skipped, 0 failed; " in said
    assert annotator("annotate", "room").startswith(
        "0 frames done, 0 proposals (0 frames without), 5 skipped, 0 failed"
    )

    assert "5 frames, " in annotator("export", "room", "--format", "rcv", "out/3D_ROOM")
    counts = json.loads(annotator("stats", "room", "--json"))
    assert (counts["frames"], counts["models"], counts["runs"], counts["frames_failed"]) == (5, 2, 2, 0)
    assert counts["labels"]["by_source"]["imported"] == 15
    dataset = read_rcv(tmp_path / "out" / "3D_ROOM")
    assert len(dataset) == 5
    assert dataset.manifest.counts.objects == counts["labels"]["total"]
    # only backends that ran are listed; briefly trained detectors may propose nothing
    proposed = dataset.manifest.counts.objects_by_source.get(Source.AUTO, 0)
    assert [detector.role for detector in dataset.manifest.detectors] == (["image", "view"] if proposed else [])

    # the manifest of each model lists its training labels
    for manifest in (tmp_path / "projects" / "room" / "models").glob("*/*-*/manifest.json"):
        entries = json.loads(manifest.read_text())["entries"]
        assert {uid for entry in entries for uid in entry["label_uids"]} == {
            label.uid for index in range(5) for label in dataset.labels(index) if label.source == "imported"
        }
