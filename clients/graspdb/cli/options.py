"""Commands that take the SDK's keywords: parameters made of its typed options, and values as it wants them.

A command says which keywords of the SDK it takes by the TypedDict (or pydantic model) that declares them::

    @takes_options
    def density(context: typer.Context, id: ObjectId, selection: Selection) -> None:
        db.objects.get(id).density(**selection)

On the command line, every field that has an :class:`graspdb.options.Option` is an option with its help; the
command gets those that were given, by the names and in the types of the SDK. Several such parameters may
stand in one command; an option that two of them declare goes to both.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import NoneType
from typing import Annotated, Any, get_args, get_origin, get_type_hints, is_typeddict

import numpy as np
import typer
from pydantic import BaseModel

from graspdb.files.trials import read_poses
from graspdb.options import Corners, Option, PoseFile, Vector

__all__ = ["Numbers", "takes_options", "vector_option"]


class Numbers(tuple[float, ...]):
    """Numbers from the command line; a class, because typer takes a tuple type for several arguments."""


def vector_option(help: str, flag: str, of: str = "x,y,z") -> Any:
    """An option that takes the comma-separated numbers ``of``."""

    def parse(text: str) -> Numbers:
        try:
            numbers = Numbers(float(part) for part in text.split(","))
        except ValueError:
            numbers = Numbers()
        if len(numbers) != of.count(",") + 1 or not all(np.isfinite(numbers)):
            raise typer.BadParameter(f"{text!r} is not {of.count(',') + 1} finite numbers {of}")
        return numbers

    parse.__name__ = of
    return typer.Option(flag, help=help, parser=parse, metavar=of)


def takes_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose parameters of a TypedDict's or model's type are its options; see above."""
    signature = inspect.signature(command, eval_str=True)
    own, models = [], {}
    for parameter in signature.parameters.values():
        if is_typeddict(parameter.annotation) or _is_model(parameter.annotation):
            models[parameter.name] = list(_fields(parameter.annotation))
        else:
            own.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
    options = {
        option.name: option for fields in models.values() for field in fields for option in field.options()
    }

    @functools.wraps(command)
    def call(**given: Any) -> None:
        values = {name: given.pop(name) for name in options}
        for name, fields in models.items():
            parsed = {field.name: field.value(values) for field in fields}
            given[name] = {key: value for key, value in parsed.items() if value is not None}
        command(**given)

    parameters = [*own, *options.values()]
    vars(call)["__signature__"] = signature.replace(parameters=parameters)
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return call


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _fields(model: type[Any]) -> Iterator[_Field]:
    """The fields that are options of commands."""
    if _is_model(model):
        declared = [(name, info.annotation, info.metadata) for name, info in model.model_fields.items()]
    else:
        hints = get_type_hints(model, include_extras=True).items()
        declared = [(name, hint, list(getattr(hint, "__metadata__", ()))) for name, hint in hints]
    for name, hint, metadata in declared:
        for option in metadata:
            if isinstance(option, Option):
                yield _Field(name, _typer_type(hint), option)


@dataclass(frozen=True)
class _Field:
    name: str
    type: type[Any]
    option: Option

    def options(self) -> Iterator[inspect.Parameter]:
        """Its parameters on the command line."""
        option = self.option
        if isinstance(option, Corners):
            yield _parameter(option.lower, Numbers, vector_option(option.help, _flag(option.lower)))
            yield _parameter(option.upper, Numbers, vector_option(option.upper_help, _flag(option.upper)))
        elif isinstance(option, Vector):
            yield _parameter(self.name, Numbers, vector_option(option.help, _flag(self.name), option.of))
        else:
            flags = [option.flag] if option.flag else []
            declared = typer.Option(*flags, help=option.help, min=option.min)
            yield _parameter(self.name, self.type, declared, option.default)

    def value(self, values: Mapping[str, Any]) -> Any:
        """What was given, as the SDK takes it; None for nothing."""
        option = self.option
        if isinstance(option, Corners):
            lower, upper = values[option.lower], values[option.upper]
            if (lower is None) != (upper is None):
                raise typer.BadParameter(f"{_flag(option.lower)} and {_flag(option.upper)} go together")
            return None if lower is None else (lower, upper)
        given = values[self.name]
        return read_poses(given) if isinstance(option, PoseFile) and given is not None else given


def _parameter(name: str, kind: Any, option: Any, default: Any = None) -> inspect.Parameter:
    hint: Any = kind if default is not None else kind | None
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[hint, option]
    )


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _typer_type(hint: Any) -> type[Any]:
    """A number or a switch where it is nothing else; the service checks a text."""
    if get_origin(hint) is Annotated:
        return _typer_type(get_args(hint)[0])
    alternatives = [item for item in get_args(hint) or [hint] if item is not NoneType]
    simple = len(alternatives) == 1 and alternatives[0] in (bool, int, float)
    return alternatives[0] if simple else str
