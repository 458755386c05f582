"""What routes take in common: the context, ids in paths, a body's bytes, what a creation takes."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Annotated, Any

from fastapi import Depends, Header, Path, Request, Response
from pydantic import WithJsonSchema

from graspdb_service.api.context import Context
from graspdb_service.problems import invalid
from graspdb_service.usecases.runtime.idempotency import Created, Sent


async def context(request: Request) -> Context:
    """The service's parts, as :func:`graspdb_service.app.create_app` put them together."""
    state: Context = request.app.state.context
    return state


Ctx = Annotated[Context, Depends(context)]


def _id(description: str) -> Any:
    """An id in a path; a longer one is of nothing, 404 as any other."""
    return Path(description=description, json_schema_extra={"maxLength": 200})


ObjectId = Annotated[str, _id("Id of the object, as it was registered.")]
GripperId = Annotated[
    str, _id("Id of the gripper, as `GET /grippers` lists it; read, too, one version, as in `panda@1`.")
]
BatchId = Annotated[str, _id("Id of the batch, as posting its trials answered it.")]
KernelId = Annotated[str, _id("Id of the kernel, as fitting or storing it answered it.")]
AnswerRef = Annotated[str, _id("Id of the answer, or a name that it was given.")]
RunId = Annotated[str, _id("Id of the run, as the 202 that started it answered it.")]
SweepId = Annotated[str, _id("Id of the sweep, as planning it answered it.")]
JobId = Annotated[str, _id("Id of the job, as the claim answered it.")]

_KeyHeader = Annotated[
    Annotated[str, WithJsonSchema({"type": "string", "maxLength": 200, "pattern": r"^[\x21-\x7e]+$"})] | None,
    Header(
        description="1 to 200 printable ASCII characters, best a UUID: the same request with the same key"
        " again is answered the same and stores nothing twice."
    ),
]


async def _key(idempotency_key: _KeyHeader = None) -> str | None:
    if idempotency_key is not None and not re.fullmatch(r"[\x21-\x7e]{1,200}", idempotency_key):
        raise invalid("Idempotency-Key", "1 to 200 printable ASCII characters, best a UUID")
    return idempotency_key


async def _raw_body(request: Request) -> bytes:
    # A bytearray, if it is one: see Received.
    return await request.body()


RawBody = Annotated[bytes, Depends(_raw_body)]
"""The body's bytes. A large body must never be a FastAPI parameter, which would validate it row by row."""


@dataclass(frozen=True)
class Creation(Sent):
    """A creating request, and the response that tells where the new thing is."""

    response: Response = field(kw_only=True)

    def answered(self, made: Created) -> object:
        self.response.headers["Location"] = made.location
        return made.body


async def _creation(response: Response, body: RawBody, key: Annotated[str | None, Depends(_key)]) -> Creation:
    return Creation(key, body, response=response)


Creating = Annotated[Creation, Depends(_creation)]
