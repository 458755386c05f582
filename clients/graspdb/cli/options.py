"""Commands that take the SDK's keywords: parameters made of its typed options, and values as it wants them.

A command of :class:`Commands` says which keywords of the SDK it takes by the TypedDict that declares them::

    @app.command("density")
    def density(state: State, id: ObjectId, selection: Selection) -> None:
        state.db.objects.get(id).density(**selection)

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
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints, is_typeddict

import numpy as np
import typer

from graspdb.cli.common import State
from graspdb.files.trials import read_drawn_poses
from graspdb.options import Corners, Option, PoseFile, Vector

__all__ = ["Commands", "Numbers", "option_names", "vector_option"]

Command = TypeVar("Command", bound=Callable[..., None])


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


class Commands(typer.Typer):
    """Commands made of functions of the run's :class:`State`, of own parameters and the SDK's keywords."""

    def command(self, name: str | None = None, **settings: Any) -> Callable[[Command], Command]:
        """Register a function as the command of this name."""
        register = super().command(name, **settings)

        def add(function: Command) -> Command:
            register(_command(function))
            return function

        return add


def option_names(*keywords: type[Any]) -> frozenset[str]:
    """Names of the parameters that options of these TypedDicts set, underscores and all."""
    return frozenset(
        option.name for model in keywords for field in _fields(model) for option in field.options()
    )


def _command(function: Callable[..., None]) -> Callable[..., None]:
    """The function as typer takes it: with the context for a state, and an option for every keyword."""
    signature = inspect.signature(function, eval_str=True)
    own, models, states = [], {}, []
    for parameter in signature.parameters.values():
        if is_typeddict(parameter.annotation):
            models[parameter.name] = list(_fields(parameter.annotation))
            continue
        if parameter.annotation is State:
            states.append(parameter.name)
            parameter = parameter.replace(annotation=typer.Context)
        own.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
    options = {
        option.name: option for fields in models.values() for field in fields for option in field.options()
    }

    @functools.wraps(function)
    def call(**given: Any) -> None:
        values = {name: given.pop(name) for name in options}
        for name, fields in models.items():
            parsed = {field.name: field.value(values) for field in fields}
            given[name] = {key: value for key, value in parsed.items() if value is not None}
        function(**given | {name: given[name].find_root().obj for name in states})

    parameters = [*own, *options.values()]
    vars(call)["__signature__"] = signature.replace(parameters=parameters)
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return call


def _fields(keywords: type[Any]) -> Iterator[_Field]:
    """The fields of a TypedDict that are options of commands."""
    for name, hint in get_type_hints(keywords, include_extras=True).items():
        for option in getattr(hint, "__metadata__", ()):
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
        return read_drawn_poses(given) if isinstance(option, PoseFile) and given is not None else given


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
