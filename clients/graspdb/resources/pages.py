"""Reading the service's lists page by page, and sending small requests made of Python values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain, islice
from typing import Any, Generic, TypeVar
from urllib.parse import quote

from pydantic import BaseModel, ValidationError

from graspdb.errors import InvalidInput
from graspdb.transport import Model, Transport
from graspdb.wire import FieldError, Problem
from graspdb.wire.base import told_of

PAGE = 1_000
"""The most items the service puts on a page."""

Item = TypeVar("Item", bound=BaseModel)


def segment(identifier: str) -> str:
    """An identifier as one segment of a path: nothing in it can reach another resource."""
    if not identifier or identifier in {".", ".."}:
        raise ValueError(f"{identifier!r} is no identifier")
    return quote(identifier, safe="")


def validate(model: type[Model], fields: Mapping[str, Any]) -> Model:
    """Build a request from what was given (None means not given); InvalidInput names every wrong field."""
    try:
        return model.model_validate({key: value for key, value in fields.items() if value is not None})
    except ValidationError as error:
        wrong = [
            FieldError(field=".".join(str(part) for part in e["loc"]) or "request", message=e["msg"])
            for e in told_of(
                error.errors(include_url=False, include_context=False, include_input=False), model
            )
        ]
        problem = Problem(type="about:blank", title="Invalid input", status=422, errors=wrong)
        # What is wrong with all of it names its fields itself.
        told = [(f"{item.field}: " if item.field != "request" else "") + item.message for item in wrong]
        text = "\n".join(["invalid input:", *(f"  {line}" for line in told)])
        raise InvalidInput(text, problem=problem) from None


class Resource:
    """Something on the service, asked about below its path."""

    def __init__(self, transport: Transport, path: str) -> None:
        self._transport = transport
        self._path = path


class Listing(Resource, Generic[Item]):
    """A list on the service, read as it is iterated; every iteration asks anew."""

    def __init__(
        self, transport: Transport, path: str, item: type[Item], params: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(transport, path)
        self._item = item
        self._params = dict(params or {})

    def pages(self, limit: int = PAGE) -> Iterator[list[Item]]:
        """Lists of at most ``limit`` items."""
        for answer in answers(self._transport, self._path, {**self._params, "limit": limit}):
            yield [self._item.model_validate(item) for item in answer["items"]]

    def __iter__(self) -> Iterator[Item]:
        return chain.from_iterable(self.pages())

    def first(self, count: int) -> list[Item]:
        """At most the first ``count`` items."""
        return list(islice(chain.from_iterable(self.pages(min(count, PAGE))), max(count, 0)))


def answers(transport: Transport, path: str, params: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """The pages of a list as the service answers them, one after the other."""
    cursor: str | None = None
    while True:
        answer = transport.json("GET", path, params={**params, "cursor": cursor})
        yield answer
        cursor = answer.get("next")
        if cursor is None:
            return
