"""JSON and YAML as the same events, one after the other: plain data only, and no more of it than is there."""

from __future__ import annotations

import functools
import importlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from graspdb.interop.grasps import problem

Event = tuple[str, Any]
"""What comes next: ``start_map``, ``map_key``, ``end_map``, ``start_array``, ``end_array``, or the kind of a
value (``number``, ``string``, ``boolean``, ``null``) with it; after each text ``end_document``.
"""

_EXTRA = "pip install 'graspdb[interop]'"
_READ_AT_ONCE = 2**18
#: Of a node of YAML that aliases repeat, and of all that they repeat.
_MOST_REPEATED, _MOST_REPEATED_IN_ALL = 100_000, 50_000_000
_NUMBER = re.compile(r"-?(?:0|[1-9][0-9]*)(?P<part>\.[0-9]+)?(?P<power>[eE][+-]?[0-9]+)?")
#: Digits of a whole number that is kept as one.
_MOST_DIGITS = 18
_PLAIN_TAGS = {f"tag:yaml.org,2002:{kind}" for kind in ("map", "seq")}


def extra(module: str, what: str) -> Any:
    """A package of the extra ``interop``; ImportError that says how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{what} needs {module.split('.')[0]}: {_EXTRA}") from error


def json_events(name: str, path: Path) -> Iterator[Event]:
    """The events of a JSON file; FileProblem says where it is none."""
    ijson = extra("ijson", "JSON")
    with path.open("rb") as file:
        if file.read(3) != b"\xef\xbb\xbf":
            file.seek(0)
        try:
            yield from ijson.basic_parse(file, use_float=True, buf_size=_READ_AT_ONCE)
        except (ijson.JSONError, UnicodeDecodeError, OverflowError) as error:
            raise problem(name, f"is no JSON: {_first_words(error)}") from None
    yield "end_document", None


def _first_words(error: Exception) -> str:
    """The parser's reason, and what stands there."""
    said = error.args[0] if error.args and isinstance(error.args[0], bytes) else str(error)
    text = said.decode("utf-8", "replace") if isinstance(said, bytes) else said
    reason, _, around = text.partition("\n")
    place = around.partition("\n")[0].strip()[:60]
    numbers = "; NaN and Infinity are no JSON numbers" if re.search(r"nan|inf", place, re.I) else ""
    return f"{' '.join(reason.split())[:200]}{f' near {place}' if place else ''}{numbers}"


def yaml_events(name: str, path: Path) -> Iterator[Event]:
    """The events of a YAML file, aliases replaced by what they stand for; FileProblem says where it is none,
    or no plain data.
    """
    yaml = extra("yaml", "YAML")
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    nodes = _Nodes(name, yaml)
    try:
        with path.open("rb") as file:
            for event in yaml.parse(file, Loader=loader):
                yield from nodes.take(event)
    except yaml.YAMLError as error:
        raise problem(name, f"is no YAML of plain data: {error}") from None
    except (RecursionError, OverflowError, UnicodeDecodeError) as error:
        raise problem(name, f"is no YAML that can be read: {error}") from None


class _Nodes:
    """Nodes of YAML on their way to events: keys told from values, aliases replaced."""

    def __init__(self, name: str, yaml: Any) -> None:
        self._name, self._yaml = name, yaml
        self._scalar = _scalars(name, yaml)
        #: For each open node None in a list, in a mapping whether a key comes next.
        self._open: list[bool | None] = []
        self._known: dict[str, list[Event]] = {}
        #: What is being written down for aliases: anchor, events, and how many nodes were open.
        self._written: list[tuple[str, list[Event], int]] = []
        self._repeated = 0

    def take(self, event: Any) -> Iterator[Event]:
        yaml = self._yaml
        if isinstance(event, yaml.ScalarEvent):
            kind, value = self._scalar(event)
            if event.anchor:
                self._known[event.anchor] = [(kind, value)]
            yield self._placed(kind, value)
        elif isinstance(event, (yaml.MappingStartEvent, yaml.SequenceStartEvent)):
            yield from self._opened(event, isinstance(event, yaml.MappingStartEvent))
        elif isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
            kind = "end_array" if self._open.pop() is None else "end_map"
            yield self._noted((kind, None))
            if self._written and self._written[-1][2] == len(self._open):
                anchor, events, _ = self._written.pop()
                self._known[anchor] = events
        elif isinstance(event, yaml.AliasEvent):
            yield from self._repeat(event.anchor)
        elif isinstance(event, yaml.DocumentEndEvent):
            self._known.clear()
            yield "end_document", None

    def _opened(self, event: Any, mapping: bool) -> Iterator[Event]:
        if event.tag is not None and event.tag not in _PLAIN_TAGS and event.tag != "!":
            raise problem(self._name, f"is no YAML of plain data: it has the tag {event.tag[:80]}")
        if event.anchor:
            self._known.pop(event.anchor, None)
            self._written.append((event.anchor, [], len(self._open)))
        yield self._placed("start_map" if mapping else "start_array", None)
        self._open.append(True if mapping else None)

    def _placed(self, kind: str, value: Any) -> Event:
        """A node's first event, as a key where one comes next."""
        if self._open and self._open[-1] is not None:
            key = self._open[-1]
            self._open[-1] = not key
            if key:
                if kind.startswith("start"):
                    raise problem(self._name, "is no YAML of plain data: a key in it is no text or number")
                return self._noted(("map_key", value))
        return self._noted((kind, value))

    def _noted(self, event: Event) -> Event:
        for _, events, _ in self._written:
            events.append(event)
            if len(events) > _MOST_REPEATED:
                raise problem(self._name, "its YAML's aliases stand for more than a file of grasps can hold")
        return event

    def _repeat(self, anchor: str) -> Iterator[Event]:
        if anchor not in self._known:
            raise problem(self._name, f"its YAML's alias {anchor[:60]} stands for itself, or for nothing")
        first, *rest = self._known[anchor]
        self._repeated += 1 + len(rest)
        if self._repeated > _MOST_REPEATED_IN_ALL:
            raise problem(self._name, "its YAML's aliases stand for more than a file of grasps can hold")
        yield self._placed(*first)
        for event in rest:
            yield self._noted(event)


def _scalars(name: str, yaml: Any) -> Callable[[Any], Event]:
    """How a scalar's text is read: as PyYAML does, and as JSON where that reads a number."""
    resolver, constructor = yaml.resolver.Resolver(), yaml.constructor.SafeConstructor()

    def constructed(tag: str, text: str) -> Event:
        try:
            value = constructor.construct_object(yaml.ScalarNode(tag, text))
        except (ValueError, OverflowError, IndexError) as error:
            raise problem(name, f"{text[:60]!r} can't be read: {error}") from None
        if value is None:
            return "null", None
        if isinstance(value, bool):
            return "boolean", value
        return ("number", value) if isinstance(value, (int, float)) else ("string", text)

    @functools.lru_cache(4096)
    def plain(text: str) -> Event:
        tag = resolver.resolve(yaml.ScalarNode, text, (True, False))
        # A merge key is the reader's.
        of_text = tag in ("tag:yaml.org,2002:str", "tag:yaml.org,2002:merge")
        return ("string", text) if of_text else constructed(tag, text)

    def scalar(event: Any) -> Event:
        text: str = event.value
        if event.tag not in (None, "!"):
            return constructed(event.tag, text)
        if not event.implicit[0]:
            return "string", text
        if found := _NUMBER.fullmatch(text):
            whole = found["part"] is None and found["power"] is None and len(text) <= _MOST_DIGITS
            return "number", int(text) if whole else float(text)
        return plain(text)

    return scalar
