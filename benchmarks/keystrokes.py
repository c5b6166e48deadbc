"""The keystroke-level model: how long an expert takes for a routine task that is done without errors.

The operators' times are those of S. K. Card, T. P. Moran and A. Newell, "The keystroke-level model for user performance
time with interactive systems", Communications of the ACM 23(7), 1980, pp. 396-410; that of a mouse button is from
D. Kieras, "Using the keystroke-level model to estimate execution times", University of Michigan, 2001. The model knows
neither tired operators nor slips.

The left hand stays on the keyboard and the right one on the mouse, as the pages of annotation tools are used; only a
number that is typed takes the right hand to the keyboard and back.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from fractions import Fraction

# K: one key, by a person who types 40 words a minute. P: pointing with the mouse. B: pressing or releasing its button.
# H: moving a hand between mouse and keyboard. M: preparing mentally, here one look at what the page shows. Seconds.
K, P, B, H, M = 0.28, 1.10, 0.10, 0.40, 1.35

KEY_S = K
# A key with Shift or Ctrl: the paper counts these as keystrokes of their own.
CHORD_S = 2 * K
CLICK_S = P + 2 * B
# Also with Ctrl.
SHIFT_CLICK_S = K + CLICK_S
DRAG_S = 2 * (P + B)


def number_s(digits: int) -> float:
    """Seconds to click into a number's field, type it and press Enter."""
    return CLICK_S + 2 * H + (digits + 1) * K


@dataclass
class Bill:
    """What an operator has done.

    Attributes:
        actions: number of keys, clicks, drags and typed numbers, by what they did; one for several tracks is divided.
        looks: number of looks at the page.
        hands_s: seconds of the hands.
        waiting_s: measured seconds of waiting for the program.
    """

    actions: defaultdict[str, Fraction] = field(default_factory=lambda: defaultdict(Fraction))
    looks: int = 0
    hands_s: float = 0.0
    waiting_s: float = 0.0

    @property
    def seconds(self) -> float:
        """All seconds."""
        return self.hands_s + M * self.looks + self.waiting_s

    @property
    def count(self) -> float:
        """Number of all actions."""
        return float(sum(self.actions.values()))

    @property
    def by_kind(self) -> dict[str, float]:
        """Number of actions by what they did, the most frequent first."""
        ordered = sorted(self.actions.items(), key=lambda entry: -entry[1])
        return {kind: int(times) if times.denominator == 1 else float(times) for kind, times in ordered}

    def act(self, kind: str, seconds: float, among: int = 1) -> None:
        """Counts one action.

        Args:
            among: so many bills share it.
        """
        self.actions[kind] += Fraction(1, among)
        self.hands_s += seconds / among

    def __add__(self, other: Bill) -> Bill:
        actions = defaultdict(Fraction, self.actions)
        for kind, times in other.actions.items():
            actions[kind] += times
        return Bill(
            actions,
            self.looks + other.looks,
            self.hands_s + other.hands_s,
            self.waiting_s + other.waiting_s,
        )
