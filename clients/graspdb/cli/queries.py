"""``graspdb density``, ``best-grasp``, ``likelihood``, ``samples`` and ``proposals``."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import typer

from graspdb.cli.common import (
    ERRORS,
    ObjectId,
    Vector,
    numbers,
    out,
    selecting,
    show_rows,
    show_table,
    state_of,
    vector_option,
)
from graspdb.errors import Infeasible
from graspdb.files.trials import read_poses
from graspdb.resources.selection import Selection
from graspdb.results import SampledPoses


@selecting
def density(
    context: typer.Context,
    id: ObjectId,
    selection: Selection,
) -> None:
    """Show an object's grasp density: kernel, widths, counts, effective sample size."""
    state = state_of(context)
    with state.client() as db:
        found = db.objects.get(id).density(
            **selection,
        )
    if state.json:
        out(found)
        return
    used = found.kernel
    rows: dict[str, Any] = {
        "object": f"{found.object}, revision {found.revision}",
        "kernel": f"{used.kind}, {used.sigma_position_m * 1e3:.1f} mm, {used.sigma_rotation_deg:.1f}°",
        "widths": used.rule,
        "selection": ", ".join(x for x in (found.gripper, found.protocol, found.source) if x) or "all trials",
        "successes": f"{found.size:,}",
        "effective sample size": f"{found.effective_sample_size:,.0f}",
        "outcomes": ", ".join(f"{n:,} {name}" for name, n in found.outcomes.items()) or "none",
        "memory": f"{found.bytes / 2**20:.1f} MiB",
    }
    for number, warning in enumerate(found.warnings, start=1):
        rows[f"warning {number}"] = warning
    show_rows(rows)


@selecting
def best_grasp(
    context: typer.Context,
    id: ObjectId,
    selection: Selection,
    count: Annotated[int, typer.Option(min=1, max=1_000, help="So many distinct grasps.")] = 1,
    objective: Annotated[
        str | None, typer.Option(help="density, success_probability (its interval's lower end) or robust.")
    ] = None,
    robust_of: Annotated[
        str | None, typer.Option(help="What robust averages: success_probability or density.")
    ] = None,
    pose_noise_m: Annotated[float | None, typer.Option(help="Noise of the object's place, per axis.")] = None,
    pose_noise_deg: Annotated[float | None, typer.Option(help="... of its turn, about its centre.")] = None,
    tool_noise_m: Annotated[float | None, typer.Option(help="Noise of the tool's place, per axis.")] = None,
    tool_noise_deg: Annotated[float | None, typer.Option(help="... of its turn.")] = None,
    box_min: Annotated[Vector | None, vector_option("Lower corner of the workspace.", "--box-min")] = None,
    box_max: Annotated[Vector | None, vector_option("Upper corner of the workspace.", "--box-max")] = None,
    sphere: Annotated[
        Vector | None, vector_option("Centre and radius.", "--sphere", count=4, metavar="x,y,z,r")
    ] = None,
    above_plane: Annotated[
        Vector | None,
        vector_option("Keep n.x >= d.", "--above-plane", count=4, metavar="nx,ny,nz,d"),
    ] = None,
    approach: Annotated[Vector | None, vector_option("Approach direction (tool z).", "--approach")] = None,
    approach_cone_deg: Annotated[float | None, typer.Option(help="Half angle about --approach.")] = None,
    closing: Annotated[Vector | None, vector_option("Closing direction (tool y).", "--closing")] = None,
    closing_cone_deg: Annotated[float | None, typer.Option(help="Half angle about --closing.")] = None,
    collision_free: Annotated[
        bool | None, typer.Option("--collision-free/--any", help="Whether the gripper must clear the object.")
    ] = None,
    pregrasp_distance_m: Annotated[
        float | None, typer.Option(help="The straight approach is free from this far back.")
    ] = None,
    max_width_m: Annotated[float | None, typer.Option(help="Fingers at most this far apart.")] = None,
    candidates: Annotated[
        str | None, typer.Option(help="Rank these poses: a file as `likelihood` reads it.")
    ] = None,
    exclude: Annotated[str | None, typer.Option(help="Stay away from these poses: a file.")] = None,
    object_pose: Annotated[
        Vector | None,
        vector_option("The object in the world.", "--object-pose", count=7, metavar="x,y,z,qx,qy,qz,qw"),
    ] = None,
    frame: Annotated[str | None, typer.Option(help="Frame of the constraints: world or object.")] = None,
    min_separation_m: Annotated[float | None, typer.Option(help="Distinct from this distance on.")] = None,
    min_separation_deg: Annotated[float | None, typer.Option(help="Distinct from this angle on.")] = None,
    prior: Annotated[
        bool | None,
        typer.Option("--prior/--no-prior", help="Before any success: whether to choose by the edges."),
    ] = None,
    verify: Annotated[
        bool, typer.Option("--verify", help="Simulate the grasps at the fine step first (needs a worker).")
    ] = False,
) -> None:
    """Find the best grasp within constraints.

    All constraints are in the world's frame if --object-pose is given, else in the object's.
    """
    if (box_min is None) != (box_max is None):
        raise typer.BadParameter("--box-min and --box-max go together")
    state = state_of(context)
    with state.client() as db:
        try:
            found = db.objects.get(id).best_grasps(
                count=count,
                objective=objective,
                robust_of=robust_of,
                pose_noise_m=pose_noise_m,
                pose_noise_deg=pose_noise_deg,
                tool_noise_m=tool_noise_m,
                tool_noise_deg=tool_noise_deg,
                pregrasp_distance_m=pregrasp_distance_m,
                max_width_m=max_width_m,
                candidates=None if candidates is None else read_poses(candidates),
                exclude=None if exclude is None else read_poses(exclude),
                box=None if box_min is None or box_max is None else (box_min, box_max),
                sphere=sphere,
                above_plane=above_plane,
                approach=approach,
                approach_cone_deg=approach_cone_deg,
                closing=closing,
                closing_cone_deg=closing_cone_deg,
                collision_free=collision_free,
                object_pose=object_pose,
                frame=frame,
                min_separation_m=min_separation_m,
                min_separation_deg=min_separation_deg,
                prior=prior,
                **selection,
                verify=verify,
            )
        except Infeasible as error:
            if state.json:
                out({"status": "infeasible", "grasps": [], "nearest": error.nearest, "message": str(error)})
                raise typer.Exit(1) from None
            raise
    if state.json:
        out(
            {
                "status": found.status,
                "ranking": found.ranking,
                "revision": found.revision,
                "kernel": found.kernel,
                "grasps": list(found),
            }
        )
        return
    if count == 1:
        rows = found[0].summary()
        show_rows(rows)
        return
    world = object_pose is not None
    show_table(
        (
            "",
            "position [m]",
            "quaternion xyzw",
            *(["in the world [m]"] if world else []),
            "density",
            "relative",
            *(["simulated"] if verify else []),
        ),
        [
            (
                number,
                numbers(g.position),
                numbers(g.quaternion_xyzw),
                *([numbers(g.world[:3, 3]) if g.world is not None else ""] if world else []),
                f"{g.density:.4g}",
                f"{g.relative:.3f}",
                *([g.simulated or ""] if verify else []),
            )
            for number, g in enumerate(found, start=1)
        ],
        empty="No grasp.",
    )
    if found[0].prior:
        ERRORS.print("Nothing has succeeded yet: chosen by the object's edges.")
    if found.status == "fewer":
        ERRORS.print(f"Only {len(found)} distinct grasps exist.")


@selecting
def likelihood(
    context: typer.Context,
    id: ObjectId,
    selection: Selection,
    file: Annotated[
        str | None, typer.Argument(help="Poses: .csv (x,y,z,qx,qy,qz,qw), .npy, .json, NDJSON.")
    ] = None,
    pose: Annotated[
        Vector | None, vector_option("One pose instead.", "--pose", count=7, metavar="x,y,z,qx,qy,qz,qw")
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="Rows of the table; --json gives all.")] = 20,
) -> None:
    """Say how likely grasps are."""
    if (file is None) == (pose is None):
        raise typer.BadParameter("give a file or --pose")
    state = state_of(context)
    poses = np.array([pose]) if file is None else read_poses(file)
    with state.client() as db:
        found = db.objects.get(id).likelihood(
            poses,
            **selection,
        )
    if state.json:
        out(found)
        return
    names = [
        name
        for name in ("density", "log_density", "relative", "success_probability", "collision_free")
        if getattr(found, name) is not None
    ]
    show_table(
        ("", "position [m]", *(name.replace("_", " ") for name in names)),
        [
            (row, numbers(poses[row, :3]), *(_cell(getattr(found, name)[row]) for name in names))
            for row in range(min(limit, len(poses)))
        ],
        empty="No poses.",
    )
    if len(poses) > limit:
        ERRORS.print(f"{len(poses) - limit:,} more; --limit shows them, --json gives all.")


def _cell(value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    return f"{value:.5g}"


@selecting
def samples(
    context: typer.Context,
    id: ObjectId,
    selection: Selection,
    count: Annotated[int, typer.Option(min=1, max=1_000_000, help="So many poses.")] = 10,
    seed: Annotated[int | None, typer.Option(min=0, help="The same seed gives the same poses.")] = None,
    csv: Annotated[
        bool, typer.Option("--csv", help="CSV that `likelihood` and `sweep --poses` read.")
    ] = False,
) -> None:
    """Draw grasps from an object's density."""
    state = state_of(context)
    with state.client() as db:
        found = db.objects.get(id).samples(
            count,
            seed=seed,
            **selection,
        )
    _show_poses(found, csv=csv, json=state.json)


@selecting
def proposals(
    context: typer.Context,
    id: ObjectId,
    selection: Selection,
    count: Annotated[int, typer.Option(min=1, max=1_000_000, help="So many poses.")] = 10,
    strategy: Annotated[
        str,
        typer.Option(
            help="density: where successes lie; uncertainty: where a trial teaches most;"
            " edges: where the jaw can close, before any trial (needs a mesh and --gripper)."
        ),
    ] = "density",
    seed: Annotated[int | None, typer.Option(min=0, help="The same seed gives the same poses.")] = None,
    csv: Annotated[
        bool, typer.Option("--csv", help="CSV that `likelihood` and `sweep --poses` read.")
    ] = False,
) -> None:
    """Draw grasps to try next; their proposal_density goes back with the trials."""
    state = state_of(context)
    with state.client() as db:
        found = db.objects.get(id).proposals(
            count,
            strategy=strategy,
            seed=seed,
            **selection,
        )
    _show_poses(found, csv=csv, json=state.json)


def _show_poses(found: SampledPoses, *, csv: bool, json: bool) -> None:
    if csv:
        typer.echo("x,y,z,qx,qy,qz,qw,proposal_density")
        for row, weight in zip(found.poses.tolist(), found.proposal_density.tolist(), strict=True):
            typer.echo(",".join(repr(value) for value in (*row, weight)))
    elif json:
        out(found)
    else:
        show_table(
            ("position [m]", "quaternion xyzw", "density"),
            [
                (numbers(p), numbers(q), f"{d:.4g}")
                for p, q, d in zip(found.position, found.quaternion_xyzw, found.proposal_density, strict=True)
            ],
            empty="No samples.",
        )
