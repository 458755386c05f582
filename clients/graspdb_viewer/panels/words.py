"""What the page says of objects, grasps and trials, as Markdown."""

from __future__ import annotations

import json
from collections.abc import Mapping

from graspdb.wire import TrialOut
from graspdb_viewer.motion import Motion

_MARKS = frozenset("\\`*_{}[]<>#|!~&$")


def table(rows: Mapping[str, object]) -> str:
    """Names and values below each other; nothing in them is markup."""
    body = "".join(f"| {plain(name)} | {plain(value)} |\n" for name, value in rows.items())
    return f"| | |\n|---|---|\n{body}"


def plain(value: object) -> str:
    """A text as Markdown shows it: what others wrote may hold anything."""
    text = " ".join(str(value).split())
    return "".join(f"&#{ord(sign)};" if sign in _MARKS else sign for sign in text)


def story(trial: TrialOut) -> str:
    """A trial's story: what became of it, who tried it with what, and what else is known."""
    rows: dict[str, object] = {"trial": f"{trial.seq:,}", "outcome": trial.outcome.replace("_", " ")}
    names = {
        "gripper": trial.gripper,
        "protocol": trial.protocol,
        "source": trial.source,
        "measured": None if trial.measured_at is None else f"{trial.measured_at:%Y-%m-%d %H:%M:%S} UTC",
        "attempts": None if trial.attempts is None else f"{trial.successes} of {trial.attempts} succeeded",
        "batch": trial.batch,
        "sweep": trial.sweep,
        "pose of the sweep": trial.pose_index,
        "answer that it tried": trial.answer,
    }
    rows |= {name: value for name, value in names.items() if value is not None}
    if trial.gripper is not None and trial.gripper_version is not None:
        rows["gripper"] = f"{trial.gripper}, version {trial.gripper_version}"
    if trial.width_m is not None:
        rows["jaw at the end"] = f"{1e3 * trial.width_m:.1f} mm open"
    if trial.proposal_density is not None:
        rows["drawn with density"] = f"{trial.proposal_density:.4g} per m³ rad³"
    for name, quality in (
        trial.qualities or ({} if trial.quality is None else {"quality": trial.quality})
    ).items():
        rows[name if name == "quality" else f"quality {name}"] = f"{quality:g}"
    if trial.achieved_pose is not None:
        rows["pose"] = "commanded; another was achieved"
    if trial.withdrawn:
        rows["withdrawn"] = "yes: it enters no estimate"
    rows["position [mm]"] = ", ".join(f"{1e3 * value:.1f}" for value in trial.position)
    for name, value in (trial.metadata or {}).items():
        rows[f"metadata {name}"] = value if isinstance(value, str) else json.dumps(value)[:300]
    return table(rows)


def replayed(motion: Motion, trial: TrialOut, slower: float) -> str:
    """What a replay showed, and whether that was how the trial went."""
    outcome = motion.outcome.replace("_", " ")
    if motion.is_of(trial):
        how = f", {slower:.0f} times slower from the first touch on" if slower > 1.5 else ""
        return (
            f"**Its worker's own states**, simulated again{how}: {outcome}, as it was, with the fingers as"
            " far apart. The jaw stands still, and the object moves in it."
        )
    return (
        f"**Not as it went**: simulated again it came out as {outcome}, and the trial as"
        f" {trial.outcome.replace('_', ' ')}{_apart(motion, trial)}. Mass, friction, convex parts or the"
        " worker are others than in its sweep."
    )


def _apart(motion: Motion, trial: TrialOut) -> str:
    if motion.width_m is None or trial.width_m is None or motion.outcome != trial.outcome:
        return ""
    return f", with the jaw {1e3 * motion.width_m:.3f} mm open and not {1e3 * trial.width_m:.3f} mm"
