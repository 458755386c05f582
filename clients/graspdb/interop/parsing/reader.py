"""What is taken from a stream of events: values, columns of numbers, and entries one at a time."""

from __future__ import annotations

import tempfile
from array import array
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from graspdb.interop.grasps import Floats, problem
from graspdb.interop.parsing.events import Event

DEEPEST = 100
MOST_VALUES = 1_000_000
"""What one entry of a file may hold, or anything else of it that is held as a whole."""

_OPENS, _CLOSES = ("start_map", "start_array"), ("end_map", "end_array")
_IN_MEMORY_BYTES = 2**23
_NUMBERS = 2**16


class Column:
    """A file's list of ``count`` numbers, or of lists of numbers of one ``shape``, kept in a temporary file.

    ``regular`` tells whether it is that; ``gaps`` and ``truths`` whether it has null, true or false among the
    numbers, which are NaN, 1 and 0 then.
    """

    def __init__(self) -> None:
        self.count = 0
        self.shape: tuple[int, ...] = ()
        self.regular = True
        self.gaps = self.truths = False
        self._file = tempfile.SpooledTemporaryFile(max_size=_IN_MEMORY_BYTES)  # noqa: SIM115

    def __len__(self) -> int:
        return self.count

    def store(self, numbers: array[float]) -> None:
        """Add numbers at the end."""
        self._file.write(numbers.tobytes())

    def take(self, start: int, stop: int) -> Floats:
        """Those from ``start`` to before ``stop``: (n, *shape)."""
        width = int(np.prod(self.shape, dtype=int))
        stop = min(stop, self.count)
        self._file.seek(8 * width * start)
        found = np.frombuffer(self._file.read(8 * width * max(0, stop - start)), np.float64)
        return found.reshape(-1, *self.shape) if self.shape else found


class Reader:
    """A file's events, from which whoever knows its format takes what he wants; FileProblem names it."""

    def __init__(self, name: str, events: Iterator[Event]) -> None:
        self._name, self._events = name, iter(events)

    def next(self) -> Event:
        """The next event."""
        try:
            return next(self._events)
        except StopIteration:
            raise problem(self._name, "ends too early") from None

    def documents(self) -> Iterator[Event]:
        """The first event of each document; each is to be taken whole before the next one."""
        for event in self._events:
            if event[0] != "end_document":
                yield event

    def keys(self) -> Iterator[Any]:
        """The keys of a mapping that has just begun; the value of each is to be taken before the next one."""
        while (event := self.next())[0] == "map_key":
            yield event[1]

    def items(self) -> Iterator[Event]:
        """The first events of a list's items; each is to be taken whole before the next one."""
        while (event := self.next())[0] != "end_array":
            yield event

    def value(self, event: Event) -> Any:
        """The value that begins with this event, as Python's."""
        kind, value = event
        if kind not in _OPENS:
            return value
        stack: list[Any] = [{} if kind == "start_map" else []]
        keys: list[Any] = [None]
        key, count = None, 0
        while True:
            kind, value = self.next()
            if kind == "map_key":
                key = value
                continue
            if kind in _OPENS:
                stack.append({} if kind == "start_map" else [])
                keys.append(key)
                self._check_depth(len(stack))
                continue
            if kind in _CLOSES:
                value, key = stack.pop(), keys.pop()
                if kind == "end_map" and "<<" in value:
                    value = _merged(value)
                if not stack:
                    return value
            count += 1
            if count > MOST_VALUES:
                raise problem(self._name, f"one of its entries holds more than {MOST_VALUES:,} values")
            if isinstance(stack[-1], list):
                stack[-1].append(value)
            else:
                stack[-1][key] = value

    def skip(self, event: Event) -> None:
        """Pass over the value that begins with this event."""
        depth = 1 if event[0] in _OPENS else 0
        while depth:
            kind = self.next()[0]
            if kind in _OPENS:
                depth += 1
                self._check_depth(depth)
            elif kind in _CLOSES:
                depth -= 1

    def column(self) -> Column:
        """The list that has just begun as a column."""
        column, numbers = Column(), array("d")
        counts, lengths, leaf = [0], dict[int, int](), 0
        while True:
            kind, value = self.next()
            if kind == "end_array":
                number = counts.pop()
                if not counts:
                    break
                if lengths.setdefault(len(counts), number) != number:
                    column.regular = False
                continue
            counts[-1] += 1
            if kind == "start_array":
                counts.append(0)
                self._check_depth(len(counts))
                continue
            if kind == "number" or kind == "boolean" or kind == "null":
                if kind == "boolean":
                    column.truths = True
                elif kind == "null":
                    column.gaps, value = True, np.nan
                if leaf != len(counts):
                    column.regular = column.regular and not leaf
                    leaf = len(counts)
                numbers.append(value)
            else:
                column.regular = False
                self.skip((kind, value))
            if len(numbers) >= _NUMBERS:
                column.store(numbers)
                numbers = array("d")
        column.store(numbers)
        column.count = number
        column.shape = tuple(lengths[level] for level in sorted(lengths))
        column.regular = column.regular and (leaf == len(lengths) + 1 or not number)
        return column

    def mapping(self, is_column: Callable[[tuple[str, ...]], bool]) -> dict[str, Any]:
        """The one document, a mapping, in which lists that ``is_column`` names by their path are columns."""
        event = self.next()
        if event[0] != "start_map":
            raise problem(self._name, "the file must be a mapping")
        found = self._mapping((), is_column)
        if self.next()[0] != "end_document":
            raise problem(self._name, "has more than one document")
        return found

    def _mapping(self, path: tuple[str, ...], is_column: Callable[[tuple[str, ...]], bool]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key in self.keys():
            here = (*path, str(key))
            if key in found:
                raise problem(self._name, f"names {'.'.join(here)[:80]} twice")
            event = self.next()
            if event[0] == "start_array" and is_column(here):
                found[key] = self.column()
            elif event[0] == "start_map" and len(here) < 2:
                found[key] = self._mapping(here, is_column)
            else:
                found[key] = self.value(event)
        return found

    def entries(self, under: Sequence[str] = ()) -> Iterator[tuple[str, Any, Any]]:
        """The entries of every document: (``entry``, name or place, value) of a list, or of the list or
        mapping that one of the keys ``under`` has, whose beginning is (``under``, key, None); (``head``,
        key, value) of what stands beside it; and (``end``, None, None) after each document.
        """
        for event in self.documents():
            if event[0] == "start_array":
                for place, item in enumerate(self.items()):
                    yield "entry", place, self.value(item)
            elif event[0] == "start_map":
                for key in self.keys():
                    first = self.next()
                    if key not in under or first[0] not in _OPENS:
                        yield "head", key, self.value(first)
                        continue
                    yield "under", key, None
                    if first[0] == "start_array":
                        for place, item in enumerate(self.items()):
                            yield "entry", place, self.value(item)
                    else:
                        for name in self.keys():
                            yield "entry", name, self.value(self.next())
            elif event[1] is not None:
                raise problem(self._name, "is no list of grasps, nor a mapping")
            yield "end", None, None

    def outlines(self) -> Iterator[Any]:
        """Ever more of the first document's outline: its keys and theirs, scalars, and of a list the first
        item.
        """
        event = next(self.documents(), ("null", None))
        if event[0] == "start_array":
            yield from ([self.value(item)] for item in self.items())
        if event[0] != "start_map":
            return
        found: dict[Any, Any] = {}
        for key in self.keys():
            for told in self._outline(self.next()):
                found[key] = told
                yield found

    def _outline(self, event: Event) -> Iterator[Any]:
        if event[0] == "start_array":
            yield []
            for place, item in enumerate(self.items()):
                if place:
                    self.skip(item)
                else:
                    yield [self.value(item)]
        elif event[0] == "start_map":
            inner: dict[Any, Any] = {}
            yield inner
            for key in self.keys():
                first = self.next()
                if first[0] == "start_array":
                    inner[key] = []
                    yield inner
                    self.skip(first)
                else:
                    inner = {**dict(list(inner.items())[:8]), key: self.value(first)}
                    yield inner
        else:
            yield event[1]

    def _check_depth(self, depth: int) -> None:
        if depth > DEEPEST:
            raise problem(self._name, "nests too deeply")


def _merged(value: dict[Any, Any]) -> dict[Any, Any]:
    """A mapping of YAML with what its merge key brings in."""
    others = value.pop("<<")
    for other in reversed(others if isinstance(others, list) else [others]):
        if isinstance(other, dict):
            value = {**other, **value}
    return value
