"""Builds the site of docs/ into site/, its reference generated from the code first: ``make docs``."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import typer
from typer.main import get_command
from typer.testing import CliRunner

DOCS = Path(__file__).parent
PROGRAMS = {
    "graspdb": "graspdb.cli:app",
    "graspdb-server": "graspdb_service.cli:cli",
    "graspdb-simworker": "graspdb_simworker.cli:app",
}
#: What a user of the SDK meets, by heading: modules and classes, as mkdocstrings names them.
SDK = {
    "Connections": ("graspdb.client.Client", "graspdb.asynchronous.AsyncClient"),
    "Objects and their trials": (
        "graspdb.resources.objects.Objects",
        "graspdb.resources.objects.GraspObject",
        "graspdb.resources.trials.Trials",
    ),
    "Answers": (
        "graspdb.resources.results.Grasp",
        "graspdb.resources.results.Grasps",
        "graspdb.resources.results.LikelihoodArrays",
        "graspdb.resources.results.SampledPoses",
        "graspdb.resources.results.TrialArrays",
        "graspdb.resources.answers.Answers",
    ),
    "Keywords of questions and uploads": (
        "graspdb.resources.selection.Selection",
        "graspdb.resources.selection.Constraints",
        "graspdb.resources.selection.AnswerFrame",
        "graspdb.resources.trials.Upload",
        "graspdb.resources.sweeps.SweepOptions",
    ),
    "Grippers, kernels, sweeps": (
        "graspdb.resources.grippers.Grippers",
        "graspdb.resources.kernels.Kernels",
        "graspdb.resources.sweeps.Sweeps",
        "graspdb.resources.sweeps.Sweep",
    ),
    "Reports": ("graspdb.reports.Reports", "graspdb.reports.AllReports"),
    "Files and poses": ("graspdb.interop", "graspdb.poses"),
    "Errors": ("graspdb.errors",),
}


def main() -> None:
    """The reference, then the site; it ends with 1 where a link leads nowhere."""
    target = DOCS / "reference"
    target.mkdir(exist_ok=True)
    (target / "http.md").write_text(http(json.loads((DOCS / "openapi.json").read_text("utf-8"))), "utf-8")
    (target / "cli.md").write_text(cli(), "utf-8")
    (target / "python.md").write_text(sdk(), "utf-8")
    words = (sys.executable, "-m", "zensical", "build", "--clean", "--strict")
    sys.exit(subprocess.run(words, cwd=DOCS.parent, check=False).returncode)


def sdk() -> str:
    """The page of the Python SDK: what mkdocstrings is to fill in."""
    parts = [
        f"## {heading}\n\n" + "\n\n".join(f"::: {name}" for name in names) for heading, names in SDK.items()
    ]
    return "# Python\n\n" + "\n\n".join(parts) + "\n"


def cli() -> str:
    """The page of the command lines: every command's own help."""
    parts = ["# Command line\n"]
    for program, place in PROGRAMS.items():
        module, _, name = place.partition(":")
        app = getattr(importlib.import_module(module), name)
        command = get_command(app) if isinstance(app, typer.Typer) else app
        parts.append(f"## {program}\n")
        for words in _commands(command, (program,)):
            level = "" if len(words) == 1 else f"### {' '.join(words)}\n\n"
            shown = CliRunner().invoke(
                app, [*words[1:], "--help"], env={"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"}
            )
            if shown.exit_code:
                raise RuntimeError(f"{' '.join(words)} --help: {shown.output}")
            parts.append(f"{level}```text\n{shown.output.strip()}\n```\n")
    return "\n".join(parts)


def _commands(command: Any, words: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """The words that call a command and those below it."""
    yield words
    for name, below in getattr(command, "commands", {}).items():
        yield from _commands(below, (*words, name))


def http(document: Mapping[str, Any]) -> str:
    """The page of the routes: what each takes and answers, from the OpenAPI document."""
    parts = ["# Routes\n", "Every route may answer a [problem](../guide/errors.md) instead.\n"]
    groups: dict[str, list[str]] = {}
    for path, methods in document["paths"].items():
        for method, route in methods.items():
            if method in ("get", "put", "post", "patch", "delete"):
                groups.setdefault((route.get("tags") or ["service"])[0], []).append(
                    _route(method, path, route)
                )
    for tag, routes in groups.items():
        parts += [f"## {tag.capitalize()}\n", *routes]
    parts += [
        "## Models\n",
        *(_model(name, schema) for name, schema in document["components"]["schemas"].items()),
    ]
    return "\n".join(parts)


def _route(method: str, path: str, route: Mapping[str, Any]) -> str:
    lines = [
        f"### {method.upper()} {path}\n",
        _plain(route.get("description", "")),
        "",
    ]
    asked = [parameter for parameter in route.get("parameters", ()) if parameter["in"] != "header"]
    if asked:
        lines += ["| parameter | | |", "|---|---|---|"]
        for each in asked:
            needed = ", required" if each.get("required") else ""
            told = _cell(each.get("description") or each["schema"].get("description", ""))
            lines.append(f"| `{each['name']}` | {_cell(_type(each['schema']))}{needed} | {told} |")
        lines.append("")
    body = route.get("requestBody", {}).get("content", {})
    if body:
        kinds = ", ".join(f"`{kind}`{_of(content)}" for kind, content in body.items())
        lines += [f"**Body:** {kinds}", ""]
    for status, answer in route.get("responses", {}).items():
        # Every route may answer a problem: the page on errors says so once.
        if status != "default":
            kinds = ", ".join(
                f"`{kind}`{_of(content)}" for kind, content in answer.get("content", {}).items()
            )
            told = _plain(answer.get("description", "")).replace("Successful Response", "").strip()
            lines.append(f"- **{status}** {': '.join(part for part in (told, kinds) if part)}")
    return "\n".join(lines) + "\n"


def _of(content: Mapping[str, Any]) -> str:
    """The model of a body, linked."""
    told = _type(content.get("schema", {}))
    return f" {told}" if "](" in told else ""


def _model(name: str, schema: Mapping[str, Any]) -> str:
    lines = [f"### {name}\n", _plain(schema.get("description", "")), ""]
    needed = set(schema.get("required", ()))
    if schema.get("properties"):
        lines += ["| field | | |", "|---|---|---|"]
        for field, of in schema["properties"].items():
            mark = ", required" if field in needed else ""
            lines.append(f"| `{field}` | {_cell(_type(of))}{mark} | {_cell(of.get('description', ''))} |")
    elif schema:
        lines.append(_type(schema))
    return "\n".join(lines) + "\n"


_LIMITS = {
    "minimum": "≥ {}", "exclusiveMinimum": "> {}", "maximum": "≤ {}", "exclusiveMaximum": "< {}",
    "minLength": "at least {} characters", "maxLength": "at most {} characters",
    "minItems": "at least {} items", "maxItems": "at most {} items", "default": "default {}",
}  # fmt: skip


def _type(schema: Mapping[str, Any]) -> str:
    """A schema in words: its type, models linked, values, limits and default."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{_slug(name)})"
    several = schema.get("anyOf") or schema.get("oneOf") or schema.get("allOf")
    if several:
        told = " or ".join(dict.fromkeys(_type(each) for each in several if each.get("type") != "null"))
    elif "enum" in schema or "const" in schema:
        told = ", ".join(f"`{json.dumps(value)}`" for value in schema.get("enum", [schema.get("const")]))
    elif schema.get("type") == "array":
        told = f"list of {_type(schema.get('items', {}))}" if schema.get("items") else "list"
    else:
        told = str(schema.get("type", "anything"))
    limits = [told_as.format(schema[key]) for key, told_as in _LIMITS.items() if schema.get(key) is not None]
    return ", ".join([told, *limits])


def _slug(heading: str) -> str:
    return re.sub(r"[^\w-]", "", heading.lower().replace(" ", "-"))


def _plain(text: str) -> str:
    """Text in which angle brackets are no markup."""
    return text.replace("<", "&lt;")


def _cell(text: str) -> str:
    return _plain(" ".join(text.split())).replace("|", "\\|")


if __name__ == "__main__":
    main()
