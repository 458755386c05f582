"""Elements of XML one after the other, whatever the file's size; types and entities are refused."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from graspdb.interop.grasps import problem
from graspdb.interop.parsing.reader import DEEPEST

_READ_AT_ONCE = 2**18
_MOST_CHARACTERS = 1_000_000
"""What one element may hold, its tags counted."""


def root_tag(name: str, path: Path) -> str:
    """The name of a file's outermost element."""
    for tag, _, _ in _parsed(name, path, (), ""):
        return tag
    raise problem(name, "is no whole XML: it has no element")


def elements(name: str, path: Path, kept: Collection[str], within: str) -> Iterator[tuple[int, Element]]:
    """The outermost elements of these names, with all that is in them, in the file's order; each with the
    number of elements ``within`` that began before it. FileProblem says where the file is no XML.
    """
    for _, number, element in _parsed(name, path, kept, within):
        if element is not None:
            yield number, element


def _parsed(
    name: str, path: Path, kept: Collection[str], within: str
) -> Iterator[tuple[str, int, Element | None]]:
    """The root's tag, then the elements."""
    building = _Building(name, kept, within)
    parser = expat.ParserCreate(namespace_separator="}")
    parser.StartElementHandler, parser.EndElementHandler = building.start, building.end
    parser.CharacterDataHandler = building.data
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = building.refuse
    parser.ExternalEntityRefHandler = building.refuse
    with path.open("rb") as file:
        content = b" "
        while content:
            content = file.read(_READ_AT_ONCE)
            try:
                parser.Parse(content, not content)
            except expat.ExpatError as error:
                raise problem(name, f"is no whole XML: {error}") from None
            yield from building.done
            building.done.clear()


class _Building:
    """What is open of a file, and the elements that are done."""

    def __init__(self, name: str, kept: Collection[str], within: str) -> None:
        self._name, self._kept, self._within = name, kept, within
        self._depth = self._number = self._size = 0
        self._builder: TreeBuilder | None = None
        self._began = 0
        self.done: list[tuple[str, int, Element | None]] = []

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        tag = local_name(tag)
        if not self._depth:
            self.done.append((tag, 0, None))
        self._depth += 1
        if self._depth > DEEPEST:
            raise problem(self._name, "its XML nests too deeply")
        self._number += tag == self._within
        if self._builder is None and tag in self._kept:
            self._builder, self._began, self._size = TreeBuilder(), self._depth, 0
        if self._builder is not None:
            self._grow(len(tag) + sum(len(key) + len(value) for key, value in attributes.items()))
            self._builder.start(tag, attributes)

    def end(self, tag: str) -> None:
        if self._builder is not None:
            self._builder.end(local_name(tag))
            if self._depth == self._began:
                self.done.append(("", self._number, self._builder.close()))
                self._builder = None
        self._depth -= 1

    def data(self, text: str) -> None:
        if self._builder is not None:
            self._grow(len(text))
            self._builder.data(text)

    def refuse(self, *_: Any) -> Any:
        raise problem(self._name, "its XML declares types or entities, which are not read")

    def _grow(self, characters: int) -> None:
        self._size += characters
        if self._size > _MOST_CHARACTERS:
            raise problem(self._name, f"an element of it has more than {_MOST_CHARACTERS:,} characters")


def local_name(tag: str) -> str:
    """A name of XML without its name space."""
    return tag.rpartition("}")[2]
