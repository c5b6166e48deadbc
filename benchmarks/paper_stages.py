"""Stages of a long run: each leaves a record, and one whose record fits its settings is not done again."""

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
    """A stage that is complete.

    Attributes:
        stage: its name.
        settings: what its outcome depends on; `after` is the key of the stage before.
        seconds: that it took.
        result: what came out.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    stage: str
    settings: dict[str, JsonValue]
    seconds: float
    result: dict[str, JsonValue]


@dataclass
class Stages:
    """Runs one stage after the other; each depends on its own settings and on all before it.

    Where one is done, those after it are done, too, whatever their records say.

    Attributes:
        folder: of the records, one JSON file a stage and settings.
        tell: is told a line when a stage begins, ends or is skipped.
        done: the records so far, by stage.
        skipped: stages that an earlier run had done.
    """

    folder: Path
    tell: Callable[[str], None]
    done: dict[str, StageRecord] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    _last: str = ""

    def run(
        self, stage: str, settings: Facts, work: Callable[[], Facts], is_kept: Callable[[Facts], bool] | None = None
    ) -> Facts:
        """The stage's result, of this run or an earlier one.

        Args:
            settings: what the outcome depends on, besides the stages before.
            work: does it. It must find what an interrupted try has left, and go on or begin anew.
            is_kept: asked whether what an earlier result speaks of is still there.

        Raises:
            FormatError: a record that cannot be read, or cannot be written.
            AnnotatorError: of the work.
        """
        known = {**settings, "after": self._last}
        key = hashlib.sha256(json.dumps([stage, known], sort_keys=True).encode()).hexdigest()[:12]
        path = self.folder / f"{stage}-{key}.json"
        record = _read(path)
        all_before = len(self.skipped) == len(self.done)
        if record is not None and all_before and (is_kept is None or is_kept(record.result)):
            self.skipped.append(stage)
            self.tell(f"{stage}: done already, in {record.seconds:.1f} s")
        else:
            self.tell(f"{stage} ...")
            begin = time.perf_counter()
            result = dict(work())
            seconds = time.perf_counter() - begin
            record = StageRecord(stage=stage, settings=known, seconds=seconds, result=result)
            self.folder.mkdir(parents=True, exist_ok=True)
            write_text(path, record.model_dump_json(indent=1))
            self.tell(f"{stage}: {seconds:.1f} s")
        self.done[stage], self._last = record, key
        return record.result


def _read(path: Path) -> StageRecord | None:
    if not path.is_file():
        return None
    try:
        return StageRecord.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise FormatError(path, f"is no record of a stage ({error}); remove it, and the stage is done again") from error
