"""Trials in whichever format a request has, or wants, them."""

from __future__ import annotations

from collections.abc import Iterator

import orjson
from fastapi import Response
from fastapi.responses import StreamingResponse

from graspdb_service.formats import trial_arrow, trial_json
from graspdb_service.formats.json_pieces import Allowed
from graspdb_service.formats.negotiation import ARROW, JSON, NDJSON, unsupported
from graspdb_service.trial_columns import TrialBatch, TrialPage


def parse(body: bytes, media: str, *, limit: int, allowed: Allowed) -> TrialBatch:
    """Check a body of trials: 415 for another media type, 413 for more than ``limit``, 422 naming fields."""
    if media in ("", JSON):
        return trial_json.parse(body, limit=limit, allowed=allowed)
    if media in (NDJSON, "application/ndjson", "application/jsonl"):
        return trial_json.parse_lines(body, limit=limit)
    if media == ARROW:
        return trial_arrow.parse(body, limit=limit)
    raise unsupported(f"Trials come as {JSON}, {NDJSON} or {ARROW}: say which by Content-Type", media)


def stream_response(
    pages: Iterator[TrialPage], kind: str, headers: dict[str, str], frame: dict[str, str]
) -> Response:
    """Trials page by page, as lines or as an Arrow stream, which says the ``frame`` of its poses."""
    content = trial_arrow.stream(pages, frame) if kind == ARROW else map(trial_json.lines, pages)
    return StreamingResponse(content, media_type=kind, headers=headers)


def page_response(
    page: TrialPage, following: str | None, kind: str, headers: dict[str, str], frame: dict[str, str]
) -> Response:
    """A page of trials; where the next one starts, the ``frame`` of poses and what it warns of stand beside
    them, but for lines.
    """
    beside = {"next": following, **frame}
    if kind == ARROW:
        body = b"".join(trial_arrow.stream([page], beside))
    elif kind == NDJSON:
        body = trial_json.lines(page)
    else:
        body = orjson.dumps({"items": trial_json.documents(page), **beside, "warnings": page.warnings})
    return Response(body, media_type=kind, headers=headers)
