"""The glossary's names exist, and the API speaks of nothing that it does not define."""

from __future__ import annotations

import ast
import functools
import json
import re
from pathlib import Path
from typing import Any

import pytest
import typer.main

from graspdb import wire
from graspdb.cli import app
from graspdb.wire import reports

ROOT = Path(__file__).parents[2]
#: Words that say what role a schema plays, not of what.
ROLES = {
    *("Info", "In", "Out", "Create", "Patch", "Spec", "Request", "Columns", "Page", "Call", "Payload"),
    *("Accepted", "Noted", "Renewed", "Response", "Stored", "Best", "World", "Row", "Rows", "Point", "Bin"),
}


def _rows() -> list[list[str]]:
    text = (ROOT / "docs/glossary.md").read_text()
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return rows[1:]


def _names(column: int) -> list[str]:
    return [name for row in _rows() for name in re.findall(r"`([^`]+)`", row[column])]


@functools.cache
def _sdk_classes() -> dict[str, ast.ClassDef]:
    files = (ROOT / "clients/graspdb").rglob("*.py")
    return {
        node.name: node
        for path in files
        if "wire" not in path.parts
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
    }


def test_a_noun_stands_once() -> None:
    nouns = [row[0] for row in _rows()]
    assert len(nouns) == len(set(nouns)) >= 25
    assert all(len(row) == 5 for row in _rows())


@pytest.mark.parametrize("name", sorted(set(_names(2))))
def test_a_name_on_the_wire_exists(name: str) -> None:
    model, _, field = name.partition(".")
    found = getattr(wire, model, None) or getattr(reports, model, None) or getattr(wire.sweeps, model)
    assert not field or field in found.model_fields


@pytest.mark.parametrize("name", sorted(set(_names(3))))
def test_a_name_in_the_sdk_exists(name: str) -> None:
    classes = _sdk_classes()
    kind, _, attribute = name.partition(".")

    def text(name: str) -> str:
        node = classes.get(name)
        if node is None:
            return ""
        return "\n".join([ast.unparse(node), *(text(ast.unparse(base)) for base in node.bases)])

    assert kind in classes
    assert not attribute or re.search(rf"(def |self\.|^ +){attribute}\b", text(kind), re.MULTILINE)


@pytest.mark.parametrize("name", sorted(set(_names(4))))
def test_a_name_on_the_command_line_exists(name: str) -> None:
    command: Any = typer.main.get_command(app)
    for word in name.split():
        if word.startswith("--"):
            assert any(word in parameter.opts for parameter in command.params)
        else:
            command = command.commands[word]


def test_the_schemas_of_the_api_are_made_of_the_glossary() -> None:
    known = {word.rstrip("s") for row in _rows() for word in row[0].split()}
    known |= {word.rstrip("s").lower() for name in _names(2) for word in _words(name.split(".")[0])}
    schemas = json.loads((ROOT / "docs/openapi.json").read_text())["components"]["schemas"]
    strangers = [
        name
        for name in schemas
        if not any(word.rstrip("s").lower() in known for word in _words(name) if word not in ROLES)
    ]
    assert strangers == []


def _words(name: str) -> list[str]:
    return re.findall(r"[A-Z][a-z]+", name)


def test_a_class_of_service_and_worker_has_a_name_of_its_own() -> None:
    homes: dict[str, list[str]] = {}
    for folder in ("service", "simworker"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    homes.setdefault(node.name, []).append(path.name)
    assert not {name: where for name, where in homes.items() if len(where) > 1}
