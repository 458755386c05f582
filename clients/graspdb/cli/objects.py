"""``graspdb objects``, ``grippers`` and ``add-example``."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from graspdb.cli.common import ERRORS, ObjectId, State, Yes, confirm, out, show_rows
from graspdb.cli.options import Commands
from graspdb.cli.wording import in_commands
from graspdb.errors import Conflict, InvalidInput, add_note
from graspdb.examples import EXAMPLES
from graspdb.resources.objects import GraspObject, ObjectProperties

objects = Commands(no_args_is_help=True, help="Create, list, show and delete objects.")
grippers = Commands(no_args_is_help=True, help="Create, list, show and delete gripper profiles.")

GripperId = Annotated[str, typer.Argument(metavar="GRIPPER", show_default=False)]
ProfileFile = Annotated[
    Path, typer.Argument(help="JSON file with the profile, as `grippers show` prints it.", show_default=False)
]
ObjectFrames = Annotated[
    list[str] | None,
    typer.Option(
        "--frame",
        metavar="NAME=x,y,z,qx,qy,qz,qw",
        help="A frame of the object, its pose in the mesh's; may stand several times.",
    ),
]
Unit = Annotated[str, typer.Option(help="Unit of the mesh: m, mm, cm or in.")]
Scale = Annotated[float, typer.Option(help="Factor to the mesh's coordinates, beside their unit.")]
AcceptDeviation = Annotated[
    bool, typer.Option("--accept-deviation", help="Take convex parts that do not follow the mesh, too.")
]


def _told(item: GraspObject) -> dict[str, str]:
    """An object's summary, with the ways out of its warnings as options."""
    return {name: in_commands(text) if "warning" in name else text for name, text in item.summary().items()}


@objects.command("list")
def list_objects(state: State) -> None:
    """List all objects."""
    state.show_list(
        [item.info for item in state.db.objects],
        {
            "object": lambda i: i.id,
            "name": lambda i: i.name,
            "trials": lambda i: i.trials,
            "successes": lambda i: i.outcomes.get("success", 0),
            "mesh": lambda i: "yes" if i.mesh else "no",
            "mass [kg]": lambda i: "" if i.mass_kg is None else f"{i.mass_kg:.3g}",
        },
        empty="No objects yet. `graspdb add-example mug` adds one.",
    )


@objects.command("show")
def show_object(state: State, id: ObjectId) -> None:
    """Show one object."""
    item = state.db.objects.get(id)
    state.show(item.info, _told(item))


@objects.command("create")
def create_object(
    state: State,
    id: ObjectId,
    properties: ObjectProperties,
    mesh: Annotated[Path | None, typer.Option(help="Mesh file: .stl, .obj, .ply or .glb.")] = None,
    unit: Unit = "m",
    scale: Scale = 1.0,
    convex_parts: Annotated[
        Path | None, typer.Option(help="GLB with one convex geometry a part, metres.")
    ] = None,
    accept_deviation: AcceptDeviation = False,
    frame: ObjectFrames = None,
) -> None:
    """Create an object, with its mesh if given."""
    if frame:
        properties["frames"] = _frames(frame)
    item = state.db.objects.create(
        id,
        mesh=mesh,
        unit=unit,
        scale=scale,
        convex_parts=convex_parts,
        accept_deviation=accept_deviation,
        **properties,
    )
    state.show(item.info, _told(item))


@objects.command("change")
def change_object(
    state: State, id: ObjectId, properties: ObjectProperties, frame: ObjectFrames = None
) -> None:
    """Change properties of an object; those not given stay."""
    item = state.db.objects.get(id)
    if frame:
        properties["frames"] = {**item.info.frames, **_frames(frame)}
    item.patch(**properties)
    state.show(item.info, _told(item))


def _frames(given: list[str]) -> dict[str, list[float]]:
    """Poses by name."""
    found = {}
    for text in given:
        name, _, numbers = text.partition("=")
        try:
            found[name] = [float(part) for part in numbers.split(",")]
        except ValueError:
            raise typer.BadParameter(
                f"{text!r} is not NAME=x,y,z,qx,qy,qz,qw", param_hint="--frame"
            ) from None
    return found


@objects.command("set-mesh")
def set_mesh(
    state: State,
    id: ObjectId,
    mesh: Annotated[Path, typer.Argument(help="Mesh file.", show_default=False)],
    unit: Unit = "m",
    scale: Scale = 1.0,
) -> None:
    """Upload an object's mesh."""
    item = state.db.objects.get(id)
    info = item.upload_mesh(mesh, unit=unit, scale=scale)
    state.show(info, _told(item))


@objects.command("set-convex-parts")
def set_convex_parts(
    state: State,
    id: ObjectId,
    parts: Annotated[
        Path, typer.Argument(help="GLB with one convex geometry a part, metres.", show_default=False)
    ],
    accept_deviation: AcceptDeviation = False,
) -> None:
    """Upload an object's convex parts."""
    item = state.db.objects.get(id)
    info = item.upload_convex_parts(parts, accept_deviation=accept_deviation)
    state.show(info, _told(item))


@objects.command("copy")
def copy_object(
    state: State,
    id: ObjectId,
    copy: Annotated[str, typer.Argument(metavar="COPY", help="Id of the copy.", show_default=False)],
    trials: Annotated[bool, typer.Option("--trials", help="Copy its trials and sweeps, too.")] = False,
) -> None:
    """Copy an object; the copy takes one other mesh though it has trials."""
    item = state.db.objects.get(id).copy(copy, trials=trials)
    state.show(item.info, _told(item))


@objects.command("delete")
def delete_object(state: State, id: ObjectId, yes: Yes = False) -> None:
    """Delete an object with its trials and sweeps."""
    item = state.db.objects.get(id)
    if not yes:
        confirm(f"Delete {id} with its {item.info.trials:,} trials?")
    item.delete()
    state.show({"deleted": id}, f"{id} is deleted.")


def add_example(
    state: State,
    names: Annotated[
        list[str], typer.Argument(metavar="NAME...", help="cone, elongated-d, screwdriver, mug, or all.")
    ],
) -> None:
    """Add the paper's objects, with mesh and convex parts."""
    added: list[GraspObject] = []
    for name in EXAMPLES if "all" in names else names:
        try:
            added.append(state.db.add_example(name))
        except Conflict:
            if "all" not in names:
                raise
            ERRORS.print(f"{name} exists already.")
            continue
        if not state.json:
            show_rows(_told(added[-1]))
    if state.json:
        out([item.info for item in added])


@grippers.command("list")
def list_grippers(state: State) -> None:
    """List all gripper profiles."""
    state.show_list(
        list(state.db.grippers),
        {
            "gripper": lambda g: g.id,
            "name": lambda g: g.name,
            "opening [mm]": lambda g: f"{g.profile.max_opening_m * 1000:.1f}",
            "force [N]": lambda g: f"{g.profile.force_n:g}",
            "friction": lambda g: f"{g.profile.friction:g}",
            "symmetric": lambda g: "yes" if g.profile.symmetric else "no",
        },
        empty="No grippers.",
    )


@grippers.command("show")
def show_gripper(state: State, id: GripperId) -> None:
    """Show one gripper profile, or a version as in panda@1: the JSON file that `grippers create` takes."""
    found = state.db.grippers.get(id)
    name = {"name": found.name} if found.name else {}
    profile = found.profile.model_dump(mode="json", exclude_none=True)
    state.show(found, json.dumps({**name, **profile}, indent=2, ensure_ascii=False))


def profile_in(file: Path) -> dict[str, Any]:
    """A profile and its name, as `grippers show` prints them."""
    try:
        given = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file} is no JSON: {error}") from None
    if not isinstance(given, dict):
        raise ValueError(f"{file} holds no JSON object")
    # With --json `grippers show` prints the service's answer, which has the profile in it.
    return {"name": given.get("name"), **given["profile"]} if "profile" in given else given


@contextmanager
def _of(file: Path) -> Iterator[None]:
    """Name the file that an invalid profile is from."""
    try:
        yield
    except InvalidInput as error:
        add_note(error, f"The profile is that of {file}.")
        raise


@grippers.command("create")
def create_gripper(
    state: State,
    id: GripperId,
    file: ProfileFile,
    name: Annotated[str | None, typer.Option(help="A name for people.")] = None,
) -> None:
    """Create a gripper profile from a JSON file."""
    fields = {**profile_in(file), **({"name": name} if name else {}), "id": id}
    with _of(file):
        created = state.db.grippers.create(**fields)
    state.show(created, f"Gripper {created.id} is created.")


@grippers.command("update")
def update_gripper(
    state: State,
    id: GripperId,
    file: ProfileFile,
    name: Annotated[str | None, typer.Option(help="Another name for people.")] = None,
) -> None:
    """Make a new version of a gripper profile from a JSON file; what was tried keeps its version."""
    fields = {**profile_in(file), "id": id, **({"name": name} if name else {})}
    with _of(file):
        updated = state.db.grippers.update(fields.pop("id"), **fields)
    changed = f": {', '.join(updated.changed)} changed" if updated.changed else ""
    state.show(updated, f"{updated.id} stands for {updated.id}@{updated.version} now{changed}.")


@grippers.command("versions")
def list_versions(state: State, id: GripperId) -> None:
    """List the versions of a gripper profile."""
    state.show_list(
        list(state.db.grippers.versions(id)),
        {
            "version": lambda g: f"{g.id}@{g.version}",
            "made": lambda g: f"{g.version_created_at:%Y-%m-%d %H:%M}" if g.version_created_at else "",
            "changed": lambda g: ", ".join(g.changed),
        },
        empty="No versions.",
    )


@grippers.command("delete")
def delete_gripper(state: State, id: GripperId) -> None:
    """Delete a gripper profile that no trial, sweep or kernel uses: its id is free then."""
    state.db.grippers.delete(id)
    state.show({"deleted": id}, f"{id} is deleted.")
