"""Sweeps from the client's side: wait for them, cancel, retry, and read every pose's outcome."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)

from graspdb import wire
from graspdb.errors import SweepFailed
from graspdb.options import Corners, Option, PoseFile
from graspdb.poses import as_poses, numbers, pose_frame, vector
from graspdb.resources.pages import Listing, Resource, answers, segment, validate
from graspdb.resources.results import TriedPoses, pose_columns, table_html
from graspdb.resources.selection import PoseFrame, answer_frame
from graspdb.transport import Transport

ProgressCallback = Callable[[wire.SweepInfo], None]
GRID_OPTIONS = ("max_poses", "position_step_m", "rotation_step_deg", "margin_m", "region")
FINISHED = frozenset({"done", "failed", "cancelled"})
_WORKER_SILENT_S = 30.0
_OUTCOMES_PAGE = 50_000
_FIRST_POLL_S, _LAST_POLL_S = 0.2, 2.0


@dataclass(frozen=True, eq=False, repr=False)
class OutcomeArrays(TriedPoses):
    """Every simulated pose of a sweep, collisions included: ``pose_index`` (N,), poses, ``outcome`` (N,), and
    of one that simulates each several times ``attempts`` and ``successes`` (N,), else None.
    """

    sweep: str
    pose_index: NDArray[np.int64]
    attempts: NDArray[np.int64] | None = None
    successes: NDArray[np.int64] | None = None

    def _columns(self) -> dict[str, Any]:
        columns = {"pose_index": self.pose_index, **pose_columns(self), "outcome": self.outcome}
        several = {"attempts": self.attempts, "successes": self.successes}
        return columns | {name: values for name, values in several.items() if values is not None}

    def __repr__(self) -> str:
        return f"OutcomeArrays({len(self)} poses of {self.sweep}, {int(self.success.sum())} successes)"


class SweepOptions(PoseFrame, total=False):
    """What a sweep simulates: a grid (the default), given ``poses``, or ``sample`` draws from the density.

    The grid has ``position_step_m``, ``rotation_step_deg``, a ``margin_m`` about the bounding box, and a
    ``region``, the box (lower, upper) it is cut to; ``max_poses`` takes a random part of it, by ``seed``.
    Poses are stored with their ``proposal_density``, (N,) or one number, 1/(m^3 rad^3), NaN where unknown; by
    default that of the samples or proposals that ``poses`` are. What poses are of: :class:`PoseFrame`.
    ``gripper`` is a profile's id, by default ``pg70``; ``protocol`` ``wrench`` (the contact forces can
    counter gravity in every direction), ``lift`` (still where it was after a lift) or ``shake`` (not lost
    when shaken without gravity; ``shake-5-100``: with up to 5 m/s^2 and 100 rad/s^2); ``fidelity``
    ``standard`` or ``fine`` (smaller time step); ``engine`` ``pybullet``, ``mujoco`` or ``both`` (two
    sweeps: see :meth:`Sweep.linked`), by default that of whichever workers come; ``randomise`` what is
    drawn anew in each of several simulations of a pose (:class:`graspdb.wire.Randomise`, a mapping or the
    number of draws): a pose then succeeds k times of n; ``purpose`` ``collect``, or ``check``: outcomes
    are stored but enter no density.
    """

    max_poses: Annotated[int | None, Option("A random part of the grid.", min=1)]
    position_step_m: Annotated[float | None, Option("Grid step, metres [0.01].")]
    rotation_step_deg: Annotated[float | None, Option("Grid step, degrees [15].")]
    margin_m: Annotated[float | None, Option("Margin about the bounding box [0.02].")]
    region: Annotated[
        tuple[ArrayLike, ArrayLike] | None,
        Corners("Cut the grid to a box.", lower="region_min", upper="region_max"),
    ]
    poses: Annotated[
        ArrayLike | Any | None, PoseFile("Simulate exactly the poses of this file (.csv, .npy, .json).")
    ]
    proposal_density: ArrayLike | None
    sample: Annotated[int | None, Option("Simulate so many draws from the density.", min=1)]
    seed: Annotated[int | None, Option("Of --max-poses or --sample.", min=0)]
    gripper: Annotated[str | None, Option("Gripper profile [pg70].")]
    protocol: Annotated[str | None, Option("wrench, lift, shake, or as hard as said: shake-5-100 [wrench].")]
    fidelity: Annotated[str | None, Option("standard or fine [standard].")]
    engine: Annotated[str | None, Option("pybullet, mujoco or both [the workers' own].")]
    randomise: Annotated[
        Mapping[str, float] | int | str | None,
        Option(
            "Simulate each pose several times: draws:10, or draws:10,friction:0.3,pose_noise_m:0.003, ..."
        ),
    ]
    purpose: Annotated[str | None, Option("collect or check [collect].")]
    chunk_poses: Annotated[int | None, Option("Poses a job.", min=1)]


class Sweep(Resource):
    """A sweep on the service. ``info`` is its state when last heard of; :meth:`refresh` asks again."""

    def __init__(self, transport: Transport, info: wire.SweepInfo) -> None:
        super().__init__(transport, f"/sweeps/{segment(info.id)}")
        self.info = info

    @property
    def id(self) -> str:
        """The sweep's identifier."""
        return self.info.id

    @property
    def state(self) -> str:
        """``queued``, ``running``, ``done``, ``failed`` or ``cancelled``, when last heard of."""
        return self.info.state

    @property
    def finished(self) -> bool:
        """True if nothing more will happen to it by itself."""
        return self.info.state in FINISHED

    def refresh(self) -> Sweep:
        """Ask the service how far it is."""
        return self._update(self._transport.json("GET", self._path))

    def linked(self) -> Sweep | None:
        """The sweep of the same poses with the other engine; None where one engine simulates them.

        Of ``engine="both"`` the first sweep, with pybullet, alone stores trials; what the second says, with
        mujoco, tells how far they can be believed. Each is waited for by itself.
        """
        if self.info.linked is None:
            return None
        path = f"/sweeps/{segment(self.info.linked)}"
        return Sweep(self._transport, self._transport.model(wire.SweepInfo, "GET", path))

    def cancel(self) -> Sweep:
        """Stop it and its linked sweep; what is already stored stays."""
        return self._update(self._transport.json("POST", f"{self._path}/cancel", idempotent=True))

    def retry(self) -> Sweep:
        """Queue the failed and cancelled chunks again, those of its linked sweep, too."""
        return self._update(self._transport.json("POST", f"{self._path}/retry", idempotent=True))

    def _update(self, answer: Any) -> Sweep:
        self.info = wire.SweepInfo.model_validate(answer)
        return self

    def wait(self, *, progress: bool | ProgressCallback = False, timeout: float | None = None) -> Sweep:
        """Wait until the sweep has finished, ``timeout`` seconds at most; it goes on all the same.

        ``progress=True`` shows a bar with rate and time left; a function is called with each
        :class:`graspdb.wire.SweepInfo`. SweepFailed if chunks failed for good: ``retry()`` queues them again.
        """
        for pause in self.pauses(progress=progress, timeout=timeout):
            time.sleep(pause)
        return self

    def pauses(
        self, *, progress: bool | ProgressCallback = False, timeout: float | None = None
    ) -> Iterator[float]:
        """:meth:`wait` for those who sleep by other means: asks, and gives the seconds until the next."""
        deadline = None if timeout is None else time.monotonic() + timeout
        bar: AbstractContextManager[ProgressCallback]
        if progress is True:
            bar = SweepBar(self)
        else:
            bar = nullcontext(progress if callable(progress) else lambda _: None)
        poll = _FIRST_POLL_S
        with bar as report:
            while True:
                self.refresh()
                report(self.info)
                if self.finished:
                    break
                if deadline is not None and time.monotonic() + poll > deadline:
                    raise TimeoutError(
                        f"sweep {self.id} is still {self.state} after {timeout:g} s"
                        f" ({self.info.poses_done} of {self.info.poses} poses done); it goes on"
                    )
                yield poll
                poll = min(poll * 1.5, _LAST_POLL_S)
        if self.info.state == "failed":
            first = self.info.failed_chunks[0].error if self.info.failed_chunks else "no reason given"
            raise SweepFailed(
                f"sweep {self.id}: {self.info.chunks_failed} of {self.info.chunks} chunks failed; the first: "
                f"{first}. `retry` queues them again.",
                failed_chunks=list(self.info.failed_chunks),
            )

    def waits_for(self) -> str | None:
        """What it waits for, in words; None once it runs. Asks the service for its workers."""
        if self.info.state != "queued":
            return None
        parts = self.info.waiting_for
        told = "a worker" if parts is None else convex_parts_told(parts)
        hint = self.hint()
        return told if hint is None else f"{told}; {hint}"

    def hint(self) -> str | None:
        """Why nothing happens, if that is for want of a worker."""
        if self.info.state != "queued":
            return None
        workers = Listing(self._transport, "/workers", wire.WorkerInfo).first(100)
        parts = self.info.waiting_for
        if workers and parts is not None and parts.state == "queued":
            if any("decompose" in worker.capabilities for worker in workers):
                return None
            return "no worker that has CoACD has come yet, which makes the convex parts: graspdb[sim]"
        engine = self.info.engine
        if workers and engine is not None and not any(engine in worker.capabilities for worker in workers):
            return f"no worker that has {engine} has come yet, and no other takes this sweep"
        if workers:
            return None
        return f"no worker has come yet: graspdb-simworker run --url {self._transport.url}"

    def outcomes(
        self,
        *,
        frame: str | None = None,
        convention: str | None = None,
        near: ArrayLike | None = None,
    ) -> OutcomeArrays:
        """Every pose of the finished chunks with its outcome, as arrays; poses as
        :class:`~graspdb.resources.selection.AnswerFrame` says.
        """
        framed = answer_frame(frame, convention, near)
        # Straight into arrays: a model of millions of rows would take longer than their simulation's answer.
        pages: list[dict[str, NDArray[Any]]] = [
            {
                "pose_index": np.array(page["pose_index"], dtype=np.int64),
                "position": np.array(page["position"], dtype=np.float64).reshape(-1, 3),
                "quaternion_xyzw": np.array(page["quaternion_xyzw"], dtype=np.float64).reshape(-1, 4),
                "outcome": np.array(page["outcome"], dtype=np.str_),
                **{
                    name: np.array(page[name], dtype=np.int64)
                    for name in ("attempts", "successes")
                    if page.get(name) is not None
                },
            }
            for page in answers(
                self._transport, f"{self._path}/outcomes", {"limit": _OUTCOMES_PAGE, **framed}
            )
        ]
        columns = {name: np.concatenate([page[name] for page in pages]) for name in pages[0]}
        told = {name: value for name, value in framed.items() if name != "near"}
        of: dict[str, Any] = {"sweep": self.id, **columns, **told}
        return OutcomeArrays(**of)

    def summary(self) -> dict[str, str]:
        """What a person wants to know of it, in words."""
        info = self.info
        rows = {
            "sweep": info.id,
            "object": info.object,
            "plan": f"{info.plan}, {info.protocol}, {info.fidelity}, {info.purpose}",
            "gripper": info.gripper,
            "engine": ", ".join(info.engines) or info.engine or "the workers' own",
            **({} if info.linked is None else {"linked sweep": info.linked}),
            **({} if info.randomise is None else {"drawn": _drawn(info.randomise)}),
            "state": info.state,
            "poses": f"{info.poses_done:,} of {info.poses:,}",
            "chunks": f"{info.chunks_done:,} of {info.chunks:,}"
            + (f", {info.chunks_failed:,} failed" if info.chunks_failed else ""),
            "outcomes": ", ".join(f"{n:,} {name}" for name, n in info.outcomes.items()) or "none yet",
        }
        if info.rate_poses_s is not None and not self.finished:
            rows["rate"] = f"{info.rate_poses_s:,.0f} poses/s"
        if info.time_left_s is not None and not self.finished:
            rows["time left"] = duration(info.time_left_s)
        for chunk in info.failed_chunks[:3]:
            rows[f"chunk {chunk.chunk} failed"] = chunk.error.strip().splitlines()[-1] if chunk.error else ""
        return rows

    def __repr__(self) -> str:
        info = self.info
        return (
            f"Sweep({info.id!r}, object={info.object!r}, state={info.state!r}, "
            f"{info.poses_done}/{info.poses} poses)"
        )

    def _repr_html_(self) -> str:
        return table_html("Sweep", self.summary())


class Sweeps(Resource):
    """``db.sweeps``: every object's sweeps."""

    def get(self, sweep: str) -> Sweep:
        """The sweep with this identifier."""
        info = self._transport.model(wire.SweepInfo, "GET", f"{self._path}/{segment(sweep)}")
        return Sweep(self._transport, info)

    def list(self, *, object: str | None = None, state: str | None = None) -> Iterator[Sweep]:
        """The sweeps, the newest first; of one object and in one state if said."""
        params = {"object": object, "state": state}
        for info in Listing(self._transport, self._path, wire.SweepInfo, params):
            yield Sweep(self._transport, info)


def create_sweep(transport: Transport, path: str, options: SweepOptions) -> Sweep:
    """Queue a sweep of the object at ``path``."""
    fields: dict[str, Any] = {name: value for name, value in options.items() if value is not None}
    seed = {name: fields.pop(name) for name in ("seed",) if name in fields}
    poses, sample = fields.pop("poses", None), fields.pop("sample", None)
    grid = {name: fields.pop(name) for name in GRID_OPTIONS if name in fields}
    if (poses is not None) + (sample is not None) + bool(grid) > 1:
        raise ValueError(
            f"give grid options ({', '.join(grid) or 'none'}), poses or sample, one of the three"
        )
    if poses is not None:
        if seed:
            raise ValueError("seed is for a grid or for sample: given poses are simulated as they are")
        given = as_poses(poses)
        fields |= pose_frame(poses, fields.get("frame"), fields.get("convention"))
        drawn = fields.pop("proposal_density", getattr(poses, "proposal_density", None))
        if drawn is not None:
            fields["proposal_density"] = numbers("proposal_density", drawn, len(given.position))
        fields["poses"] = given.columns()
    elif sample is not None:
        fields["sample"] = {"count": sample, **seed}
    else:
        if "region" in grid:
            corners = zip(("lower", "upper"), grid["region"], strict=True)
            grid["region"] = {
                end: vector(f"region's {end} corner", corner, "x, y, z") for end, corner in corners
            }
        fields["grid"] = {**grid, **seed}
    if "randomise" in fields:
        fields["randomise"] = _randomise(fields["randomise"])
    request = validate(wire.SweepCreate, fields)
    info = transport.model(wire.SweepInfo, "POST", f"{path}/sweeps", body=request, idempotent=True)
    return Sweep(transport, info)


def _drawn(asked: wire.Randomise) -> str:
    """What is drawn of each pose, in words."""
    spreads = asked.model_dump(exclude={"draws", "seed"}).items()
    told = ", ".join(f"{name} {spread:g}" for name, spread in spreads if spread)
    return f"each pose {asked.draws} times: {told}"


def _randomise(given: Mapping[str, float] | int | str) -> Any:
    """What is drawn, of a mapping, a number of draws, or ``draws:10,friction:0.3``."""
    if isinstance(given, int):
        return {"draws": given}
    if not isinstance(given, str):
        return given
    if given.isdigit():
        return {"draws": int(given)}
    parts = [part.partition(":") for part in given.split(",")]
    if not all(colon for _, colon, _ in parts):
        raise ValueError(f"randomise: {given!r} is not NAME:NUMBER,NAME:NUMBER, as in draws:10,friction:0.3")
    return {name.strip(): value for name, _, value in parts}


def convex_parts_told(waiting: wire.sweeps.WaitingFor) -> str:
    """How far the decomposition is that a sweep waits for, in words."""
    told = f"convex parts: {waiting.progress or waiting.state}"
    if waiting.worker is not None:
        told += f", on {waiting.worker}"
    last = (waiting.error or "").strip().splitlines()
    return f"{told} (the last attempt: {last[-1]})" if last else told


def duration(seconds: float) -> str:
    """Seconds for people: ``45 s``, ``3 min 20 s``, ``2 h 05 min``."""
    whole = round(seconds)
    if whole < 90:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


class SweepBar(AbstractContextManager[ProgressCallback]):
    """A progress bar that follows a sweep, on stderr so that stdout stays clean for data."""

    def __init__(self, sweep: Sweep, title: str | None = None) -> None:
        self._sweep = sweep
        self._title = title or f"sweep {sweep.info.object}"
        self._silent_since = time.monotonic()
        self._hint: str | None = None
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=Console(stderr=True),
        )

    def __enter__(self) -> ProgressCallback:
        info = self._sweep.info
        self._task = self._progress.add_task(
            self._title, total=info.poses, completed=info.poses_done, rate="", left=""
        )
        self._progress.start()
        return self._show

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def _show(self, info: wire.SweepInfo) -> None:
        waiting = info.state == "queued" and time.monotonic() - self._silent_since > _WORKER_SILENT_S
        if waiting:
            self._silent_since = time.monotonic()
            self._hint = self._sweep.hint()
        if info.state != "queued":
            self._hint = None
        rate = "" if info.rate_poses_s is None else f"{info.rate_poses_s:,.0f} poses/s"
        left = ""
        if self._hint:
            left = self._hint
        elif info.waiting_for is not None and info.state == "queued":
            left = convex_parts_told(info.waiting_for)
        elif info.state in FINISHED or info.state == "queued":
            left = info.state
        elif info.time_left_s is not None:
            left = f"{duration(info.time_left_s)} left"
        self._progress.update(
            self._task, total=info.poses, completed=info.poses_done, rate=rate, left=left, refresh=True
        )
