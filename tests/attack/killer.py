"""Kills of a command at moments that are spread over its run time."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from mortal import End, Mortal


class Killer:
    """Kills a command at moments that are spread over its run time.

    Attributes:
        killed: how often the kill came before the end.
        migration: statements of one more migration, which the commands have.
    """

    def __init__(self, mortal: Mortal, template: Path, folder: Path, times: int, chance: random.Random) -> None:
        self.mortal, self.template, self.folder, self.times, self.chance = mortal, template, folder, times, chance
        self.killed = 0
        self.migration: Sequence[str] = ()

    def fresh(self) -> Path:
        """A new copy of the template."""
        shutil.rmtree(self.folder, ignore_errors=True)
        return Path(shutil.copytree(self.template, self.folder))

    def whole(self, *words: str | Path) -> End:
        """Runs a command to its end, which must succeed."""
        end = self.mortal.run(*words, migration=self.migration)
        assert end.code == 0, end
        return end

    def kills(self, *words: str | Path, done: Callable[[], object] = lambda: None) -> Iterator[End]:
        """Kills the command once per iteration, on a fresh copy; at least half the kills must hit.

        Args:
            done: undoes what a whole run has written outside the copy.
        """
        # the first run reads files that later ones find in memory
        for _ in range(2):
            self.fresh()
            seconds = self.whole(*words).seconds
            done()
        for number in range(self.times):
            self.fresh()
            moment = seconds * (number + self.chance.random()) / self.times
            end = self.mortal.run(*words, kill_s=moment, migration=self.migration)
            assert end.code in (0, -9), end
            self.killed += end.was_killed
            yield end
        assert self.killed * 2 >= self.times, f"only {self.killed} of {self.times} kills came before the end"
