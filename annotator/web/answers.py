"""Answers that pydantic writes by itself: for a frame with a hundred boxes FastAPI takes several times as long."""

from __future__ import annotations

from typing import Any

from fastapi.responses import JSONResponse
from pydantic import BaseModel

from annotator.types.errors import StaleRevisionError
from annotator.web.context import Context
from annotator.web.errors import ErrorBody
from annotator.web.shown import frame_state
from annotator.web.wire import FrameStateJson


class ModelResponse(JSONResponse):
    """A pydantic model as JSON. It is not validated again: whoever makes it knows what is in it."""

    def render(self, content: Any) -> bytes:
        """The model's JSON."""
        model: BaseModel = content
        return model.model_dump_json().encode()


class BothVersions(BaseModel):
    """The answer to a change that came too late: why, what is there now, and what was sent."""

    error: ErrorBody
    state: FrameStateJson
    changes: Any


def frame_answer(ctx: Context, name: str, frame_id: int, who: str) -> ModelResponse:
    """The present state of a frame; errors as `frame_state`."""
    return ModelResponse(frame_state(ctx, name, frame_id, who))


def stale_answer(
    ctx: Context, name: str, frame_id: int, who: str, error: StaleRevisionError, sent: Any
) -> ModelResponse:
    """Both versions of a frame; errors as `frame_state`."""
    told = ErrorBody(kind=type(error).__name__, message=str(error))
    state = frame_state(ctx, name, frame_id, who)
    return ModelResponse(BothVersions.model_construct(error=told, state=state, changes=sent), 409)
