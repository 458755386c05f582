"""Outcomes of a sweep's poses, as JSON columns or an Arrow stream."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import Any

import numpy as np
from fastapi import Response
from fastapi.responses import StreamingResponse

from graspdb.wire import OUTCOMES
from graspdb_service.formats import arrow
from graspdb_service.formats.columns import columns_json
from graspdb_service.formats.negotiation import ARROW
from graspdb_service.trial_columns import TrialColumns

_HEADERS = {"Vary": "Accept"}


def stream_response(sweep: str, pages: Iterator[TrialColumns]) -> Response:
    """All outcomes as an Arrow stream."""
    return StreamingResponse(
        _stream({"sweep": sweep, "next": None}, pages), media_type=ARROW, headers=_HEADERS
    )


def page_response(sweep: str, page: TrialColumns, following: str | None, kind: str) -> Response:
    """A page of outcomes; where the next one starts stands beside them."""
    head: dict[str, Any] = {"sweep": sweep, "next": following}
    if kind == ARROW:
        return Response(b"".join(_stream(head, iter([page]))), media_type=ARROW, headers=_HEADERS)
    columns = {name: getattr(page, name) for name in ("pose_index", "position", "quaternion_xyzw")}
    outcome = np.array(OUTCOMES, dtype=object)[page.outcome].tolist()
    return columns_json({"sweep": sweep, "outcome": outcome, "next": following}, columns, _HEADERS)


def _stream(told: dict[str, Any], pages: Iterator[TrialColumns]) -> Iterator[bytes]:
    batches = (
        arrow.record_batch(
            {
                "pose_index": page.pose_index,
                "position": arrow.vectors(page.position, 3),
                "quaternion_xyzw": arrow.vectors(page.quaternion_xyzw, 4),
                "outcome": arrow.outcome_names(page.outcome),
            },
            told,
        )
        for page in pages
    )
    first = next(batches)
    return arrow.stream(first.schema, chain([first], batches))
