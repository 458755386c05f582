"""``graspdb density``, ``best-grasp``, ``likelihood``, ``samples`` and ``proposals``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.markup import escape

from graspdb.cli.common import (
    ERRORS,
    ObjectId,
    State,
    numbers,
    out,
    out_csv,
    show_findings,
    show_rows,
    show_table,
)
from graspdb.cli.options import Numbers, vector_option
from graspdb.cli.wording import in_commands
from graspdb.errors import Infeasible
from graspdb.figures.style import number, widths
from graspdb.files.trials import read_poses
from graspdb.poses import as_poses, as_vector7
from graspdb.resources.results import (
    Grasp,
    Grasps,
    LikelihoodArrays,
    SampledPoses,
    SupportArrays,
    chance,
    pose_columns,
)
from graspdb.resources.selection import (
    Constraints,
    DrawSelection,
    LikelihoodSelection,
    ProposalSelection,
    Selection,
)
from graspdb.wire import DensityInfo, EstimatorInfo, SelectionInfo

Count = Annotated[int, typer.Option(min=1, max=1_000_000, help="So many poses.")]
Seed = Annotated[int | None, typer.Option(min=0, help="The same seed gives the same poses.")]
Csv = Annotated[bool, typer.Option("--csv", help="CSV that `likelihood` and `sweep --poses` read.")]


def _successes(found: DensityInfo) -> str:
    """How many grasps a density is of, in words: some of them succeeded in few of several attempts only."""
    few = found.size - found.outcomes.get("success", 0)
    return f"{found.size:,}" + (f", {few:,} of them in less than half of their attempts" if few > 0 else "")


def density(state: State, id: ObjectId, selection: Selection) -> None:
    """Show an object's grasp density: kernel, widths, counts, effective sample size."""
    found = state.db.objects.get(id).density(**selection)
    rows: dict[str, Any] = {
        "object": f"{found.object}, revision {found.revision}",
        "kernel": f"{found.kernel.kind}, {widths(found.kernel)}",
        "widths": found.kernel.rule,
        "selection": ", ".join(x for x in (found.gripper, found.protocol, found.source) if x) or "all trials",
        "successes": _successes(found),
        "effective sample size": f"{found.effective_sample_size:,.0f}",
        "outcomes": ", ".join(f"{n:,} {name}" for name, n in found.outcomes.items()) or "none",
        "memory": f"{found.bytes / 2**20:.1f} MiB",
    }
    rows |= _sources_told(found.selection)
    rows |= {
        f"warning {number}": in_commands(warning) for number, warning in enumerate(found.warnings, start=1)
    }
    state.show(found, rows)
    if not state.json:
        show_findings(found.findings)


def _sources_told(selection: SelectionInfo | None) -> dict[str, str]:
    """Each source's trials and share of the weight, where there are several."""
    sources = {} if selection is None else selection.sources
    told = {
        f"of {name}": f"{item.successes:,} successes of {item.trials:,} trials,"
        f" {item.share_of_weight:.1%} of the weight"
        for name, item in sources.items()
    }
    return told if len(told) > 1 else {}


def best_grasp(
    state: State,
    id: ObjectId,
    constraints: Constraints,
    count: Annotated[int, typer.Option(min=1, max=1_000, help="So many distinct grasps.")] = 1,
    verify: Annotated[
        bool, typer.Option("--verify", help="Simulate the grasps at the fine step first (needs a worker).")
    ] = False,
    csv: Annotated[bool, typer.Option("--csv", help="CSV with all scores; poses in both frames.")] = False,
    picture: Annotated[
        Path | None,
        typer.Option(help="Also write a PNG of the gripper at the best grasp.", show_default=False),
    ] = None,
) -> None:
    """Find the best grasp within constraints.

    All constraints are in the world's frame if --object-pose is given, else in the object's; --reference
    object keeps them in the object's. A table of several grasps has their poses in that frame.
    """
    try:
        found = state.db.objects.get(id).best_grasps(count=count, verify=verify, **constraints)
    except Infeasible as error:
        if state.json:
            told = {"conflict": error.conflict, "relax": error.relax, "message": str(error)}
            out({"status": "infeasible", "grasps": [], "nearest": error.nearest, **told})
            raise typer.Exit(1) from None
        raise
    if picture is not None:
        picture.write_bytes(found[0].picture(width=960, height=720))
        ERRORS.print(f"The best grasp, drawn: {escape(str(picture))}", highlight=False, soft_wrap=True)
    if state.json:
        head = ("frame", "convention", "reference", "status", "ranking", "revision", "kernel", "selection")
        names = (
            *head,
            "estimator",
            "calibration",
            "symmetry",
            "warnings",
            "answer",
            "newer_revision",
            "stale",
        )
        out({**{name: getattr(found, name) for name in names}, "grasps": list(found)})
    elif csv:
        out_csv(found.columns())
    elif count == 1:
        show_rows({**found[0].summary(), **_ranked_by(found)})
        _tell_kept(found)
        if found[0].success_probability is not None:
            _tell_estimator(found.estimator)
    else:
        _show_grasps(found, in_world=found[0].world is not None and found.reference == "world")
    if not state.json:
        _mind(found.warnings)


def _mind(warnings: Sequence[str]) -> None:
    """What a person should know before relying on an answer."""
    for warning in warnings:
        ERRORS.print(f"Mind: {escape(in_commands(warning))}", highlight=False, soft_wrap=True)


def _tell_kept(found: Grasps) -> None:
    """That a name's answer is older than the object is now."""
    if found.newer_revision is not None:
        ERRORS.print(
            f"The name keeps this answer of revision {found.revision}; the object is at"
            f" {found.newer_revision}: leave --name out for today's.",
            soft_wrap=True,
        )


def _ranked_by(found: Grasps) -> dict[str, str]:
    """The score of the best grasp and what it is, unless it is the density, which is shown anyhow."""
    best, ranking = found[0], found.ranking
    if best.score is None or ranking is None or ranking.objective == "density":
        return {}
    return {"ranked by": f"{ranking.score}: {best.score:.4g}"}


def _show_grasps(found: Grasps, *, in_world: bool) -> None:
    frame = f"{_head(found.frame)}{'world ' if in_world else ''}"
    columns: dict[str, Callable[[Grasp], Any]] = {
        "": lambda g: 1 + found.index(g),
        f"{frame}position [m]": lambda g: numbers(_matrix(g, in_world)[:3, 3]),
        f"{frame}quaternion xyzw": lambda g: numbers(as_poses(_matrix(g, in_world)).quaternion_xyzw[0]),
        f"{'world ' if in_world else ''}approach": lambda g: numbers(_approach(g, in_world), digits=2),
        "density": lambda g: f"{g.density:.4g}",
        "relative": lambda g: f"{g.relative:.3f}",
        "success probability": lambda g: "unknown" if g.success_probability is None else g.chance(),
        "expected untried": lambda g: number(g.prior_success_probability),
        "nearest attempt": _nearest,
        "score": lambda g: None if g.score is None else f"{g.score:.4g}",
        "simulated": lambda g: g.simulated,
    }
    ranked_by = _ranked_by(found)
    if not ranked_by:
        del columns["score"]
    if found[0].simulated is None:
        del columns["simulated"]
    if all(g.support is None for g in found):
        del columns["success probability"]
    if all(_nearest(g) is None for g in found):
        del columns["nearest attempt"]
    if all(g.prior_success_probability is None for g in found):
        del columns["expected untried"]
    show_table(found, columns, empty="No grasp.")
    _tell_frame(found.frame, found.convention, "world" if in_world else "object")
    _tell_kept(found)
    if found.ranking is not None and ranked_by:
        ERRORS.print(f"The score that they are ranked by is the {found.ranking.score}.", soft_wrap=True)
    if found.reach is not None and any(g.support is not None and not g.support.enough for g in found):
        ERRORS.print(f"Success probabilities are told {found.reach.rule}.", soft_wrap=True)
    if any(g.success_probability is not None for g in found):
        _tell_estimator(found.estimator)
    if any(g.prior_success_probability is not None for g in found):
        _tell_prior(found.estimator)
    if found[0].prior:
        ERRORS.print("Nothing has succeeded yet: chosen by the object's edges.")
    if found.status == "fewer":
        ERRORS.print(f"Only {len(found)} distinct grasps exist.")


def _head(frame: str) -> str:
    """What stands before the names of a pose's columns."""
    return "" if frame == "tool" else f"{frame} "


def _tell_frame(frame: str, convention: str, reference: str = "object") -> None:
    """What a table's poses are of, and in."""
    axes = "" if convention == "graspdb" else f", with the axes of {convention},"
    ERRORS.print(f"Poses are of the {frame}{axes} in the {reference} frame.", highlight=False, soft_wrap=True)


def _matrix(grasp: Grasp, in_world: bool) -> NDArray[np.float64]:
    return grasp.world if in_world and grasp.world is not None else grasp.matrix


def _approach(grasp: Grasp, in_world: bool) -> NDArray[np.float64]:
    tool = grasp.tool_world if in_world else None
    return grasp.approach if tool is None else tool[:3, 2]


def _nearest(grasp: Grasp) -> str | None:
    if grasp.support is None or grasp.support.nearest_attempt is None:
        return None
    nearest = grasp.support.nearest_attempt
    return _distance(nearest.position_m, nearest.rotation_deg)


def _distance(position_m: float, rotation_deg: float) -> str:
    return f"{1e3 * position_m:.1f} mm, {rotation_deg:.0f}°" if np.isfinite(position_m) else "none"


def likelihood(
    state: State,
    id: ObjectId,
    selection: LikelihoodSelection,
    file: Annotated[
        str | None, typer.Argument(help="Poses: .csv (x,y,z,qx,qy,qz,qw), .npy, .json, NDJSON.")
    ] = None,
    pose: Annotated[Numbers | None, vector_option("One pose instead.", "--pose", "x,y,z,qx,qy,qz,qw")] = None,
    limit: Annotated[int, typer.Option(min=1, help="Rows of the table; --json and --csv give all.")] = 20,
    csv: Annotated[bool, typer.Option("--csv", help="CSV: every pose and what is known of it.")] = False,
) -> None:
    """Say how likely grasps are."""
    if (file is None) == (pose is None):
        raise typer.BadParameter("give a file or --pose")
    poses = read_poses(file) if file is not None else np.array([as_vector7(pose, "--pose")])
    found = state.db.objects.get(id).likelihood(poses, **selection)
    if state.json:
        out(found)
        return
    _mind(found.warnings)
    if csv:
        out_csv(pose_columns(as_poses(poses)) | found.columns())
        return
    frame, convention = selection.get("frame") or "tool", selection.get("convention") or "graspdb"
    columns: dict[str, Callable[[int], Any]] = {
        "": int,
        f"{_head(frame)}position [m]": lambda row: numbers(poses[row, :3]),
    }
    for name in ("density", "log_density", "relative", "collision_free", "prior_success_probability"):
        if (values := getattr(found, name)) is not None:
            columns[name.replace("_", " ")] = partial(_cell, values)
    if found.support is not None:
        columns["success probability"] = partial(_chance, found)
        columns["nearest attempt"] = partial(_nearest_of, found.support)
    show_table(range(min(limit, len(poses))), columns, empty="No poses.")
    _tell_frame(frame, convention)
    if found.reach is not None and found.support is not None and not found.support.enough.all():
        ERRORS.print(f"Success probabilities are told {found.reach.rule}.", soft_wrap=True)
    if found.support is not None:
        _tell_estimator(found.estimator)
    if len(poses) > limit:
        ERRORS.print(f"{len(poses) - limit:,} more; --limit shows them, --json and --csv give all.")


def _tell_estimator(estimator: EstimatorInfo | None) -> None:
    """Who told success probabilities, where it is more than the plain kernel estimate, or soon will be."""
    if estimator is None:
        return
    if estimator.state == "fitting":
        ERRORS.print("Better success probabilities are being learned: ask again in a minute.")
    elif estimator.attempts is not None:
        of, out = "", "blocks"
        if estimator.objects is not None:
            of, out = f" at {estimator.objects} other objects", "objects"
        ERRORS.print(
            f"Success probabilities were learned from {estimator.attempts:,} attempts{of} ({estimator.name}):"
            f" Brier skill on left-out {out} {number(estimator.skill)}, of kernels"
            f" {number(estimator.kernel_skill)}.",
            soft_wrap=True,
        )


def _tell_prior(estimator: EstimatorInfo | None) -> None:
    """Who told what is expected where nothing was tried, if that is more than geometry."""
    prior = None if estimator is None else estimator.prior
    if prior is not None and prior.attempts is not None:
        ERRORS.print(
            f"What is expected untried was learned from {prior.attempts:,} attempts at {prior.objects} other"
            f" objects: Brier skill on left-out ones {number(prior.skill)}.",
            soft_wrap=True,
        )


def _chance(found: LikelihoodArrays, row: int) -> str:
    """A probability with its interval and effective trials, never without."""
    likely, ends, trials = found.success_probability, found.interval, found.effective_trials
    if likely is None or ends is None or trials is None:
        return "unknown"
    return chance(likely[row], ends.low[row], ends.high[row], trials[row])


def _nearest_of(support: SupportArrays, row: int) -> str:
    near = support.nearest_attempt
    return _distance(near.position_m[row], near.rotation_deg[row])


def _cell(values: Any, row: int) -> str:
    value = values[row]
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    return f"{value:.5g}"


def samples(
    state: State,
    id: ObjectId,
    selection: DrawSelection,
    count: Count = 10,
    seed: Seed = None,
    csv: Csv = False,
) -> None:
    """Draw grasps from an object's density."""
    _show_poses(state, state.db.objects.get(id).samples(count, seed=seed, **selection), csv)


def proposals(
    state: State,
    id: ObjectId,
    selection: ProposalSelection,
    count: Count = 10,
    strategy: Annotated[
        str,
        typer.Option(
            help="density: where successes lie; uncertainty: where a trial teaches most;"
            " edges: where the jaw can close, before any trial (needs a mesh and --gripper);"
            " expected_improvement: what raises the success probability of the best grasp within bounds most."
        ),
    ] = "density",
    pre_opening_m: Annotated[
        str | None, typer.Option(help="How far open the jaw comes: metres, or auto.", show_default=False)
    ] = None,
    seed: Seed = None,
    csv: Csv = False,
) -> None:
    """Draw grasps to try next; their proposal_density goes back with the trials."""
    drawn = state.db.objects.get(id).proposals(
        count, strategy=strategy, pre_opening_m=pre_opening_m, seed=seed, **selection
    )
    _show_poses(state, drawn, csv)


def _show_poses(state: State, found: SampledPoses, csv: bool) -> None:
    if csv:
        out_csv(found.columns())
    elif state.json:
        out(found)
    else:
        columns: dict[str, Callable[[int], Any]] = {
            f"{_head(found.frame)}position [m]": lambda row: numbers(found.position[row]),
            f"{_head(found.frame)}quaternion xyzw": lambda row: numbers(found.quaternion_xyzw[row]),
            "density": lambda row: f"{found.proposal_density[row]:.4g}",
        }
        if found.support is not None:
            columns["nearest attempt"] = partial(_nearest_of, found.support)
            columns["within reach"] = partial(_cell, found.support.enough)
        if found.opening_m is not None:
            columns["opening [m]"] = partial(_cell, found.opening_m)
        if found.expected_gain is not None:
            columns["expected gain"] = partial(_cell, found.expected_gain)
        show_table(range(len(found)), columns, empty="No samples.")
        _tell_frame(found.frame, found.convention)
