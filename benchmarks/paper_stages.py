"""Stages of a long run: each stores a record, and a stage whose record matches its settings is skipped."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import BaseModel, ConfigDict, JsonValue, ValidationError

from annotator.formats.json_file import write_text
from annotator.types.errors import FormatError

Facts = Mapping[str, JsonValue]


class StageRecord(BaseModel):
    """A completed stage.

    Attributes:
        stage: name of the stage.
        settings: everything on which the result depends; `after` is the key of the previous stage.
        seconds: duration.
        result: the stage's result.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    stage: str
    settings: dict[str, JsonValue]
    seconds: float
    result: dict[str, JsonValue]


@dataclass
class Stages:
    """Runs stages one after the other; each depends on its settings and on all previous stages.

    If a stage runs, all later stages run as well, even if they have a record.

    Attributes:
        folder: folder of the records, one JSON file per stage and settings.
        log: called with a line of text when a stage starts, ends or is skipped.
        done: the records so far, by stage.
        skipped: stages that an earlier run completed.
    """

    folder: Path
    log: Callable[[str], None]
    done: dict[str, StageRecord] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    _last: str = ""

    def run(
        self, stage: str, settings: Facts, work: Callable[[], Facts], is_kept: Callable[[Facts], bool] | None = None
    ) -> Facts:
        """Runs a stage, or returns its result from an earlier run.

        Args:
            stage: name of the stage.
            settings: everything on which the result depends besides the previous stages.
            work: does the work. It must resume or restart after an interrupted run.
            is_kept: returns whether the files or rows that an earlier result refers to still exist.

        Raises:
            FormatError: a record cannot be read or written.
            AnnotatorError: the work failed.
        """
        all_settings = {**settings, "after": self._last}
        key = hashlib.sha256(json.dumps([stage, all_settings], sort_keys=True).encode()).hexdigest()[:12]
        path = self.folder / f"{stage}-{key}.json"
        record = _read(path)
        all_before = len(self.skipped) == len(self.done)
        if record is not None and all_before and (is_kept is None or is_kept(record.result)):
            self.skipped.append(stage)
            self.log(f"{stage}: already done (took {record.seconds:.1f} s)")
        else:
            self.log(f"{stage} ...")
            begin = time.perf_counter()
            result = dict(work())
            seconds = time.perf_counter() - begin
            record = StageRecord(stage=stage, settings=all_settings, seconds=seconds, result=result)
            self.folder.mkdir(parents=True, exist_ok=True)
            write_text(path, record.model_dump_json(indent=1))
            self.log(f"{stage}: {seconds:.1f} s")
        self.done[stage], self._last = record, key
        return record.result


def _read(path: Path) -> StageRecord | None:
    if not path.is_file():
        return None
    try:
        return StageRecord.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise FormatError(path, f"not a record of a stage ({error}); delete it to run the stage again") from error
