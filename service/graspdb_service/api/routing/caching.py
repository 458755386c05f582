"""ETags, and the answers that they spare."""

from __future__ import annotations

import hashlib
from typing import Any

import orjson
from fastapi import Request, Response
from pydantic import BaseModel

from graspdb.wire import Selection
from graspdb_service import __version__
from graspdb_service.usecases.trials.selection import Selected


def etag(*parts: object) -> str:
    """A weak ETag of what an answer depends on."""
    return 'W/"' + ".".join(str(part) for part in parts) + '"'


def answer_tag(selected: Selected, revision: int, query: Selection, kept: str | None = None) -> str:
    """What an answer depends on: object, revision, the gripper's profile, the question, and who answers;
    beside that the id that it is ``kept`` under.
    """
    question = hashlib.sha256(
        f"{type(query).__name__} {query.model_dump_json(exclude={'timeout_s'})}".encode()
    ).hexdigest()[:24]
    parts = (selected.row.id, revision, selected.stamp, question, __version__)
    return etag(*parts) if kept is None else etag(*parts, kept)


def not_modified(request: Request, tag: str) -> Response | None:
    """304 where the client already has this answer, else None."""
    seen = request.headers.get("if-none-match")
    if seen is None:
        return None
    tags = {item.strip().removeprefix("W/") for item in seen.split(",")}
    if "*" in tags or tag.removeprefix("W/") in tags:
        return Response(status_code=304, headers={"ETag": tag})
    return None


def seen_after(request: Request, tag: str) -> list[str]:
    """What tags that the client has add to this one."""
    start = tag.removeprefix("W/").removesuffix('"') + "."
    seen = (item.strip().removeprefix("W/") for item in request.headers.get("if-none-match", "").split(","))
    return [item.removeprefix(start).removesuffix('"') for item in seen if item.startswith(start)]


def tagged_json(request: Request, content: Any, *, tag: str | None = None) -> Response:
    """A JSON answer with an ETag (by default of its content), or 304 where the client has it already."""
    model = isinstance(content, BaseModel)
    body = content.model_dump_json().encode() if model else orjson.dumps(content)
    tag = tag or etag(hashlib.sha256(body).hexdigest()[:32])
    return not_modified(request, tag) or Response(body, media_type="application/json", headers={"ETag": tag})
