"""``graspdb objects``, ``grippers`` and ``add-example``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from graspdb.cli.common import ERRORS, ObjectId, out, show_rows, show_table, state_of
from graspdb.errors import Conflict
from graspdb.resources.objects import GraspObject

objects = typer.Typer(no_args_is_help=True, help="Create, list, show and delete objects.")
grippers = typer.Typer(no_args_is_help=True, help="Create, list and show gripper profiles.")

MeshFile = Annotated[Path | None, typer.Option(help="Mesh file: .stl, .obj, .ply or .glb.")]
Unit = Annotated[str, typer.Option(help="Unit of the mesh: m, mm, cm or in.")]


@objects.command("list")
def list_objects(context: typer.Context) -> None:
    """List all objects."""
    state = state_of(context)
    with state.client() as db:
        found = [item.info for item in db.objects.list()]
    if state.json:
        out(found)
        return
    show_table(
        ("object", "name", "trials", "successes", "mesh", "mass [kg]"),
        [
            (
                i.id,
                i.name,
                i.trials,
                i.outcomes.get("success", 0),
                "yes" if i.mesh else "no",
                _mass(i.mass_kg),
            )
            for i in found
        ],
        empty="No objects yet. `graspdb add-example mug` adds one.",
    )


def _mass(mass: float | None) -> str:
    return "" if mass is None else f"{mass:.3g}"


@objects.command("show")
def show_object(context: typer.Context, id: ObjectId) -> None:
    """Show one object."""
    state = state_of(context)
    with state.client() as db:
        _show(db.objects.get(id), state.json)


def _show(item: GraspObject, as_json: bool) -> None:
    if as_json:
        out(item.info)
    else:
        show_rows(item.summary())


@objects.command("create")
def create_object(
    context: typer.Context,
    id: ObjectId,
    mesh: MeshFile = None,
    unit: Unit = "m",
    convex_parts: Annotated[
        Path | None, typer.Option(help="GLB with one convex geometry a part, metres.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="A name for people.")] = None,
    mass_kg: Annotated[float | None, typer.Option("--mass-kg", help="Mass in kg.")] = None,
    density_kg_m3: Annotated[
        float | None, typer.Option("--density-kg-m3", help="Mass density, where the mass is not known.")
    ] = None,
    friction: Annotated[float | None, typer.Option(help="Coefficient of friction.")] = None,
) -> None:
    """Create an object, with its mesh if given."""
    state = state_of(context)
    with state.client() as db:
        created = db.objects.create(
            id,
            mesh=mesh,
            unit=unit,
            convex_parts=convex_parts,
            name=name,
            mass_kg=mass_kg,
            density_kg_m3=density_kg_m3,
            friction=friction,
        )
        _show(created, state.json)


@objects.command("set-mesh")
def set_mesh(
    context: typer.Context,
    id: ObjectId,
    mesh: Annotated[Path, typer.Argument(help="Mesh file.", show_default=False)],
    unit: Unit = "m",
) -> None:
    """Upload an object's mesh."""
    state = state_of(context)
    with state.client() as db:
        item = db.objects.get(id)
        info = item.upload_mesh(mesh, unit=unit)
        if state.json:
            out(info)
        else:
            show_rows(item.summary())


@objects.command("delete")
def delete_object(
    context: typer.Context,
    id: ObjectId,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
) -> None:
    """Delete an object with its trials and sweeps."""
    state = state_of(context)
    with state.client() as db:
        item = db.objects.get(id)
        if not yes:
            typer.confirm(f"Delete {id} with its {item.info.trials:,} trials?", abort=True, err=True)
        item.delete()
    if state.json:
        out({"deleted": id})
    else:
        typer.echo(f"{id} is deleted.")


def add_example(
    context: typer.Context,
    names: Annotated[
        list[str], typer.Argument(metavar="NAME...", help="cone, elongated-d, screwdriver, mug, or all.")
    ],
) -> None:
    """Add the paper's objects, with mesh and convex parts."""
    from graspdb.examples import EXAMPLES

    state = state_of(context)
    wanted = list(EXAMPLES) if "all" in names else names
    added: list[GraspObject] = []
    with state.client() as db:
        for name in wanted:
            try:
                added.append(db.add_example(name))
            except Conflict:
                if "all" not in names:
                    raise
                ERRORS.print(f"{name} exists already.")
                continue
            if not state.json:
                show_rows(added[-1].summary())
    if state.json:
        out([item.info for item in added])


@grippers.command("list")
def list_grippers(context: typer.Context) -> None:
    """List all gripper profiles."""
    state = state_of(context)
    with state.client() as db:
        found = list(db.grippers.list())
    if state.json:
        out(found)
        return
    show_table(
        ("gripper", "name", "opening [mm]", "force [N]", "friction", "symmetric"),
        [
            (
                g.id,
                g.name,
                f"{g.profile.max_opening_m * 1000:.1f}",
                f"{g.profile.force_n:g}",
                f"{g.profile.friction:g}",
                "yes" if g.profile.symmetric else "no",
            )
            for g in found
        ],
        empty="No grippers.",
    )


@grippers.command("show")
def show_gripper(
    context: typer.Context, id: Annotated[str, typer.Argument(metavar="GRIPPER", show_default=False)]
) -> None:
    """Show one gripper profile."""
    state = state_of(context)
    with state.client() as db:
        found = db.grippers.get(id)
    if state.json:
        out(found)
        return
    rows: dict[str, Any] = {"gripper": found.id}
    if found.name:
        rows["name"] = found.name
    for name, value in found.profile.model_dump(mode="json").items():
        for key, item in value.items() if isinstance(value, dict) else [("", value)]:
            rows[f"{name}.{key}".rstrip(".")] = item
    show_rows(rows)


@grippers.command("create")
def create_gripper(
    context: typer.Context,
    id: Annotated[str, typer.Argument(metavar="GRIPPER", show_default=False)],
    file: Annotated[Path, typer.Argument(help="JSON file with the profile's fields.", show_default=False)],
    name: Annotated[str | None, typer.Option(help="A name for people.")] = None,
) -> None:
    """Create a gripper profile from a JSON file."""
    state = state_of(context)
    profile = json.loads(file.read_text(encoding="utf-8"))
    if not isinstance(profile, dict):
        raise ValueError(f"{file} holds no JSON object")
    fields = {**profile, **({"name": name} if name else {}), "id": id}
    with state.client() as db:
        created = db.grippers.create(**fields)
    if state.json:
        out(created)
    else:
        typer.echo(f"Gripper {created.id} is created.")
