"""Numbers of JSON files that can be calculated with: no NaN, and nothing whose square or product overflows."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from annotator.types.tracks import MOST_TRACK

# A thousand times the way to the sun, metres.
MOST = 1e14

Bounded = Annotated[float, Field(ge=-MOST, le=MOST, allow_inf_nan=False)]
BoundedPositive = Annotated[float, Field(gt=0, le=MOST, allow_inf_nan=False)]
# A track id, also where all numbers are floats.
BoundedTrack = Annotated[int, Field(ge=-MOST_TRACK, le=MOST_TRACK)]
Exact = Annotated[float, Field(ge=-MOST_TRACK, le=MOST_TRACK, allow_inf_nan=False)]
Bounded3 = tuple[Bounded, Bounded, Bounded]
Bounded4 = tuple[Bounded, Bounded, Bounded, Bounded]
