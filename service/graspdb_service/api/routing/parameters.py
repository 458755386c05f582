"""What routes take in common: the context, ids in paths, a body's bytes, what a creation takes."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, cast

from fastapi import Depends, Header, Path, Query, Request, Response
from pydantic import WithJsonSchema

from graspdb.wire import Convention, Slug
from graspdb.wire.base import Licence, Quadruple
from graspdb.wire.frames.asking import ASKED_CONVENTION, ASKED_FRAME, ASKED_NEAR, NearQuery
from graspdb.wire.frames.gripper_frames import FrameName
from graspdb.wire.trials import BatchDefaults, Origin
from graspdb_service.api.context import Context
from graspdb_service.problems import invalid
from graspdb_service.usecases.runtime.idempotency import Created, Sent
from graspdb_service.usecases.trials.frames import AskedFrame


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
RobotId = Annotated[str, _id("Id of the robot, as it was stored.")]
SceneId = Annotated[str, _id("Id of the scene, as it was stored.")]
KernelId = Annotated[str, _id("Id of the kernel, as fitting or storing it answered it.")]
AnswerRef = Annotated[str, _id("Id of the answer, or a name that it was given.")]
RunId = Annotated[str, _id("Id of the run, as the 202 that started it answered it.")]
SweepId = Annotated[str, _id("Id of the sweep, as planning it answered it.")]
JobId = Annotated[str, _id("Id of the job, as the claim answered it.")]


async def _framed(
    frame: Annotated[FrameName | None, Query(description=ASKED_FRAME)] = None,
    convention: Annotated[Convention | None, Query(description=ASKED_CONVENTION)] = None,
) -> AskedFrame:
    return AskedFrame(frame, convention)


Framed = Annotated[AskedFrame, Depends(_framed)]
"""What poses of trials are of that are sent."""


async def _framed_answer(
    asked: Framed, near: Annotated[NearQuery, Query(description=ASKED_NEAR)] = None
) -> AskedFrame:
    # What it is after its check.
    return replace(asked, near=cast("Quadruple | None", near))


FramedAnswer = Annotated[AskedFrame, Depends(_framed_answer)]
"""What poses are to be of that are answered."""

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


UnderLicence = Annotated[
    str | None,
    Query(max_length=100, description="Only what came in batches under this licence; by default all."),
]


async def _told_of_batch(
    licence: Annotated[
        Licence | None,
        Query(description="Licence of the batch, for bodies that have no place for it; null if unknown."),
    ] = None,
    citation: Annotated[
        str | None, Query(max_length=4_000, description="What to cite for the batch; null for nothing.")
    ] = None,
    origin_file: Annotated[
        str | None,
        Query(min_length=1, max_length=255, description="Name of the file that was read; null for none."),
    ] = None,
    origin_format: Annotated[
        Slug | None, Query(description="Format of that file, such as `acronym`; null if unknown.")
    ] = None,
    origin_sha256: Annotated[
        str | None,
        Query(pattern="^[0-9a-f]{64}$", description="SHA-256 of that file in hexadecimal; null if unknown."),
    ] = None,
) -> BatchDefaults:
    parts = {"file": origin_file, "format": origin_format, "sha256": origin_sha256}
    read_from = {name: value for name, value in parts.items() if value is not None}
    origin = Origin(**read_from) if read_from else None
    told: dict[str, Any] = {"licence": licence, "citation": citation, "origin": origin}
    return BatchDefaults.model_construct(**{name: value for name, value in told.items() if value is not None})


ToldOfBatch = Annotated[BatchDefaults, Depends(_told_of_batch)]
"""What the address of a request with trials says of the batch that they make."""
