"""What the service says to those who call it over HTTP, in the words of the command line.

The service's problems and warnings name a way out: a request, a parameter. Here is the command that makes
that request, and the option that sets that parameter.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from rich.markup import escape

from graspdb.cli.common import ERRORS
from graspdb.cli.options import option_names
from graspdb.errors import GraspDBError
from graspdb.reports import (
    AnisotropyOptions,
    ConvergenceOptions,
    KernelSimilarityOptions,
    ProjectionOptions,
    PromisesOptions,
)
from graspdb.resources.kernels import KernelOptions
from graspdb.resources.objects import ObjectProperties
from graspdb.resources.selection import Constraints
from graspdb.resources.sweeps import SweepOptions
from graspdb.resources.trials import TrialFilters, Upload

COMMANDS: Mapping[str, str] = {
    "GET /objects": "objects list",
    "POST /objects": "objects create",
    "PATCH /objects/OBJECT": "objects change OBJECT",
    "POST /objects/OBJECT/copies": "objects copy OBJECT COPY --trials",
    "PUT /objects/OBJECT/mesh": "objects set-mesh OBJECT FILE",
    "PUT /objects/OBJECT/convex-parts": "objects set-convex-parts OBJECT FILE",
    "GET /objects/OBJECT/trials": "trials list OBJECT",
    "POST /objects/OBJECT/trials": "trials add OBJECT FILE",
    "DELETE /objects/OBJECT/trials/SEQ": "trials withdraw OBJECT SEQ",
    "GET /objects/OBJECT/batches": "batches list OBJECT",
    "DELETE /objects/OBJECT/batches/BATCH": "batches delete OBJECT BATCH",
    "POST /objects/OBJECT/best-grasp": "best-grasp OBJECT",
    "POST /objects/OBJECT/sweeps": "sweep OBJECT",
    "GET /answers/ANSWER": "answers get ANSWER",
    "DELETE /answers/ANSWER": "answers delete ANSWER",
    "GET /grippers": "grippers list",
    "POST /grippers": "grippers create",
    "PUT /grippers/GRIPPER": "grippers update GRIPPER FILE",
    "GET /robots": "robots list",
    "PUT /robots/ROBOT": "robots put ROBOT FILE",
    "GET /scenes": "scenes list",
    "PUT /scenes/SCENE": "scenes put SCENE FILE",
    "GET /kernels": "kernels list",
    "POST /kernels": "kernels fit OBJECT",
    "GET /sweeps": "sweeps list",
    "GET /keys": "keys list",
    "POST /sweeps/SWEEP/cancel": "sweeps cancel SWEEP",
    "POST /sweeps/SWEEP/retry": "sweeps retry SWEEP",
}
"""The command of every request that the service names as a way out; ids in capitals."""

_PARAMETERS = option_names(
    *(Constraints, SweepOptions, KernelOptions, ObjectProperties, TrialFilters, Upload),
    *(ConvergenceOptions, AnisotropyOptions, ProjectionOptions, KernelSimilarityOptions, PromisesOptions),
) | {"unit", "scale", "mesh"}
#: Flags whose opposite has a name of its own.
_OPPOSITES = {"collision_free": "any"}
_CALL = re.compile(r"\b(GET|POST|PUT|DELETE|PATCH) (/[\w{}./-]*[\w}])(?:\?([\w=]+)(?:=\.\.\.|\.\.\.)?)?")
_FOR_BOTH = re.compile(r"(\?\w+=\w+)? \(on the command line (--[^()]+)\)")
#: What several are named for to choose from, as in ``name one (gripper: panda, pg70)``, or none.
_NAME_ONE = re.compile(r"(?<=name one )\([^()]*\)")
#: A field of a question at the head of what is wrong with it, which need not look like a parameter.
_QUESTIONED = option_names(Constraints)
_FIELD = re.compile(r"(?m)(?<=^  )[a-z]+(?=: |\.\d)")
_PARAMETER = re.compile(r"(?<![\w.\-])\??(?:\w+\([^()]*\)|([a-z_]+)=([\w.-]*)|([a-z]+(?:_[a-z]+)+))")


def in_commands(text: str) -> str:
    """The text with commands in the place of requests, and options in that of parameters."""
    # What is said for both is said for one: the option, not the parameter beside it.
    text = _FOR_BOTH.sub(lambda found: found[2] if found[1] else f" ({found[2]})", text)
    said, at = "", 0
    for call in _CALL.finditer(text):
        if call.start() < at:
            continue
        command = _command(call[1], call[2])
        if command is None:
            continue
        body, end = _body(text, call.end())
        options = [*_options(body), *([f"--{call[3].rstrip('=')} ..."] if call[3] else [])]
        command = command.replace("OBJECT", str(body.get("object", "OBJECT")))
        said += in_options(text[at : call.start()]) + " ".join(("`graspdb", command, *options)) + "`"
        at = end
    return said + in_options(text[at:])


def in_options(text: str) -> str:
    """The text with options in the place of parameters: ``gripper=`` and ``max_poses`` are ours, too."""
    text = _NAME_ONE.sub(lambda found: re.sub(r"\b(gripper|protocol)(?=[:)])", r"--\1", found[0]), text)
    text = _FIELD.sub(lambda found: _flag(found[0]) if found[0] in _QUESTIONED else found[0], text)
    return _PARAMETER.sub(_option, text)


def _command(method: str, path: str) -> str | None:
    """The command that makes a request, with the ids that its path has."""
    parts = path.strip("/").split("/")
    for request, command in COMMANDS.items():
        verb, pattern = request.split(" /")
        places = pattern.split("/")
        alike = len(places) == len(parts) and all(
            place.isupper() or place == part for place, part in zip(places, parts, strict=True)
        )
        if verb == method and alike:
            for place, part in zip(places, parts, strict=True):
                if place.isupper() and "{" not in part:
                    command = command.replace(place, part)
            return command
    return None


def _body(text: str, at: int) -> tuple[dict[str, Any], int]:
    """The JSON object that follows a request, and where it ends; ``[...]`` in it stands for a file."""
    if not text.startswith(" {", at):
        return {}, at
    end = text.find("}", at) + 1
    while end and text.count("{", at, end) > text.count("}", at, end):
        end = text.find("}", end) + 1
    try:
        body = json.loads(text[at:end].replace("[...]", '"FILE"'))
    except ValueError:
        return {}, at
    return body, end


def _options(body: Mapping[str, Any]) -> Iterator[str]:
    """A request's fields as options of its command."""
    for name, value in body.items():
        if name == "sample":
            yield f"--sample {value['count']}"
        elif isinstance(value, Mapping):
            yield from _options(value)
        elif name != "object":
            yield f"{_flag(name)} {value}"


def _option(found: re.Match[str]) -> str:
    name = found[1] or found[3]
    if name not in _PARAMETERS:
        return found[0]
    if found[2] in ("true", "false"):
        return _flag(name if found[2] == "true" else _OPPOSITES.get(name, f"no_{name}"))
    return f"{_flag(name)} {found[2]}" if found[2] else _flag(name)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def told(error: Exception) -> bool:
    """Whether an error is one to tell a person in words, which is done then; anything else is a bug."""
    # TimeoutError is an OSError.
    if not isinstance(error, (GraspDBError, ValueError, ImportError, OSError)):
        return False
    message = in_commands(str(error))
    ERRORS.print(f"[bold red]Error:[/] {escape(message)}", highlight=False, soft_wrap=True)
    tell_notes(error)
    return True


def tell_notes(error: BaseException) -> bool:
    """Tell what an error notes besides; whether there is anything."""
    notes = getattr(error, "__notes__", [])
    for note in notes:
        ERRORS.print(escape(in_commands(note)), highlight=False, soft_wrap=True)
    return bool(notes)
