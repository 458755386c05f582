"""``graspdb demo``: the whole chain on this machine, from nothing to grasps that hold in a finer simulation.

Service and worker run as processes of their own, exactly as in a laboratory; this module only talks to them.
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from statistics import NormalDist
from types import FrameType
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape

from graspdb.client import Client
from graspdb.errors import Conflict, GraspDBError, Infeasible
from graspdb.poses import matrices
from graspdb.processes import ChildProcess
from graspdb.resources.objects import GraspObject
from graspdb.resources.results import Grasp
from graspdb.resources.sweeps import OutcomeArrays, Sweep, SweepBar, duration

__all__ = ["Children", "DemoFailed", "demo", "wilson_interval"]

MAX_POSES = 600_000
"""A random part of the mug's grid: enough for thousands of successes in one to five minutes of two cores."""
DRAWS = 100
BEST = 10
LEVEL = 0.90
LOG_LINES = 15
START_S = 120.0
STOP_S = 10.0
VIEWER_PORT = 8080
PICTURES = Path("demo")
"""Where pictures are left, if no folder is named."""
_STOPPING = (signal.SIGINT, signal.SIGTERM)

# The workspace: the mug stands on a table half a metre in front of the robot, turned by 30 degrees, and
# the gripper comes from above into a box around it, steeper than the best grasp overall, which of a small
# sweep is from below and of a large one slanting (46 degrees).
WORKSPACE_BOX = ((0.35, -0.05, 0.03), (0.65, 0.25, 0.25))
WORKSPACE_APPROACH = (0.0, 0.0, -1.0)
WORKSPACE_CONE_DEG = 30.0
TURN_DEG = 30.0


class DemoFailed(GraspDBError):
    """The demo could not go on; the message says why, with the last lines of the log concerned."""


class Children:
    """The processes of the demo: in sessions of their own, stopped in order, and ended with it in any case.

    A context: within it Ctrl-C and SIGTERM raise, and are remembered, because an exception raised in the
    midst of somebody's import may be swallowed there; :meth:`check` raises it again. In the midst of a start
    they wait until it is known what has been started.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: list[tuple[str, ChildProcess]] = []
        self._starting = False
        self._before: dict[signal.Signals, Any] = {}
        self._signal: int | None = None

    def __enter__(self) -> Children:
        self._before = {number: signal.signal(number, self._interrupt) for number in _STOPPING}
        return self

    def __exit__(self, *_: object) -> None:
        for number in _STOPPING:
            signal.signal(number, signal.SIG_IGN)  # a second Ctrl-C would leave some of them running
        try:
            self._stop()
        finally:
            for number, handler in self._before.items():
                signal.signal(number, handler)

    def _interrupt(self, number: int, _frame: FrameType | None) -> None:
        self._signal = number
        if not self._starting:
            self._raise_interrupt()

    def _raise_interrupt(self) -> None:
        if self._signal == signal.SIGINT:
            raise KeyboardInterrupt
        if self._signal is not None:
            raise SystemExit(128 + self._signal)

    def start(self, program: str, *arguments: str) -> None:
        """Start a command of this installation; its output goes to ``<program>.log`` in the folder."""
        beside = Path(sys.executable).with_name(program)
        path = str(beside) if beside.exists() else shutil.which(program)
        if path is None:
            raise DemoFailed(f"{program} is not installed: pip install 'graspdb[service,sim,examples]'")
        environment = {key: value for key, value in os.environ.items() if not key.startswith("GRASPDB_")}
        self._starting = True
        try:
            with (self._folder / f"{program}.log").open("wb") as log:
                process = ChildProcess(
                    [path, *arguments],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    cwd=self._folder,
                    env=environment,
                    start_new_session=True,  # Ctrl-C comes to the demo alone, which stops them in order
                )
            self._running.append((program, process))
        finally:
            self._starting = False
        self._raise_interrupt()

    def check(self) -> None:
        """Raise :class:`DemoFailed` if one has ended, or the interruption there was."""
        self._raise_interrupt()
        for program, process in self._running:
            code = process.poll()
            if code is not None:
                how = f"ended with exit code {code}" if code >= 0 else f"was killed by signal {-code}"
                raise DemoFailed(f"{program} {how}. Its last lines:\n{self.log(program)}")

    def log(self, program: str) -> str:
        """The last lines a child wrote."""
        lines = (self._folder / f"{program}.log").read_text(errors="replace").splitlines()
        return "\n".join(f"  {line}" for line in lines[-LOG_LINES:]) or "  (it wrote nothing)"

    def _stop(self) -> None:
        """Ask the last started first, then kill what is left of each one's session."""
        for _, process in reversed(self._running):
            if process.poll() is None:
                process.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(STOP_S)
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        self._running.clear()


def wilson_interval(successes: int, trials: int, level: float = LEVEL) -> tuple[float, float]:
    """Wilson's score interval (1927) of a share, two-sided at ``level``; ValueError where there is none."""
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"{successes} successes of {trials} trials")
    z = NormalDist().inv_cdf(0.5 + level / 2)
    share, spread = successes / trials, z * z / trials
    centre = (share + spread / 2) / (1 + spread)
    half = math.sqrt(share * (1 - share) * spread + spread * spread / 4) / (1 + spread)
    return max(0.0, centre - half), min(1.0, centre + half)


def demo(
    keep: Annotated[
        bool, typer.Option("--keep", help="Leave service and worker running until Ctrl-C.")
    ] = False,
    view: Annotated[
        bool, typer.Option("--view", help="Show the first object in a browser at the end; implies --keep.")
    ] = False,
    objects: Annotated[
        str, typer.Option(help="Examples to grasp, comma-separated: cone, elongated-d, screwdriver, mug.")
    ] = "mug",
    max_poses: Annotated[
        int, typer.Option(min=1_000, help="Poses of the grid to simulate, an object.")
    ] = MAX_POSES,
    processes: Annotated[
        int | None, typer.Option(min=1, help="Simulating processes; by default one a core.")
    ] = None,
    port: Annotated[int | None, typer.Option(help="Of the service; by default 8000 or a free one.")] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="Keep database, logs and pictures there; by default they are scratch, pictures in demo/."
        ),
    ] = None,
) -> None:
    """From nothing to a best grasp: service, worker, real physics, density, queries and a check of them."""
    # A log gets whole lines, a terminal lines broken between words.
    console = Console(highlight=False, soft_wrap=not sys.stdout.isatty())
    names = [name.strip() for name in objects.split(",") if name.strip()]
    if view and importlib.util.find_spec("viser") is None:
        raise ImportError("--view needs the viewer: pip install 'graspdb[view]'")
    keep, started = keep or view, time.monotonic()
    try:
        with (
            _folder(folder) as place,
            _running(place, port, processes or _cores(), console) as (db, children),
        ):
            pictures = PICTURES if folder is None else place
            lines = [_grasp_example(db, children, name, max_poses, console, pictures) for name in names]
            console.rule("Summary")
            for line in lines:
                console.print(line)
            stays = "" if keep else " (while it runs: --keep, or make demo KEEP=1, leaves it running)"
            console.print(f"API docs: {db.url}/docs{stays}")
            console.print(f"Took {duration(time.monotonic() - started)}.")
            if view:
                _view(db, children, names[0], console)
            if keep:
                _hold(db, children, names[0], console)
    except KeyboardInterrupt:
        console.print("\nInterrupted; everything is stopped.")
        raise typer.Exit(130) from None


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def _folder(given: Path | None) -> Iterator[Path]:
    if given is not None:
        given.mkdir(parents=True, exist_ok=True)
        yield given.resolve()
        return
    with tempfile.TemporaryDirectory(prefix="graspdb-demo-", ignore_cleanup_errors=True) as scratch:
        yield Path(scratch)


@contextlib.contextmanager
def _running(
    folder: Path, port: int | None, processes: int, console: Console
) -> Iterator[tuple[Client, Children]]:
    """Service and worker, ready to be asked; stopped at the end."""
    port = _port(port)
    url = f"http://127.0.0.1:{port}"
    with Children(folder) as children:
        with console.status("Starting the service ..."):
            where = ("--host", "127.0.0.1", "--port", str(port))
            database = f"sqlite:///{folder / 'graspdb.sqlite'}"
            children.start("graspdb-server", "serve", *where, "--database-url", database)
            with Client(url) as db:
                deadline = time.monotonic() + START_S
                while not db.ready():
                    children.check()
                    if time.monotonic() > deadline:
                        raise DemoFailed(f"no answer in {START_S:g} s:\n{children.log('graspdb-server')}")
                    time.sleep(0.1)
        children.check()  # who answered might be another's service on that port
        children.start("graspdb-simworker", "run", "--url", url, "--processes", str(processes))
        console.print(f"The service answers at {url} (docs: {url}/docs), on SQLite in {escape(str(folder))}.")
        console.print(f"A worker with {processes} simulating process{'es' * (processes > 1)} runs beside it.")
        with Client(url) as db:
            try:
                yield db, children
            except GraspDBError:
                children.check()  # a dead child is the cause, and says more than its consequence
                raise


def _port(wanted: int | None, usual: int = 8000) -> int:
    """The wanted port, else the usual one, else a free one."""
    for candidate in (wanted,) if wanted is not None else (usual, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", candidate))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise DemoFailed(f"port {wanted} is taken; --port names another")


def _wait(sweep: Sweep, children: Children, title: str) -> Sweep:
    with SweepBar(sweep, title) as show:

        def report(info: object) -> None:
            children.check()
            show(sweep.info)

        return sweep.wait(progress=report)


def _grasp_example(
    db: Client, children: Children, name: str, max_poses: int, console: Console, pictures: Path
) -> str:
    """Sweep, density, queries and check of one object; the line for the summary."""
    console.rule(name)
    item = db.add_example(name)
    children.check()
    console.print(f"Registered: {escape(repr(item))}")
    began = time.monotonic()
    sweep = _wait(item.sweep(max_poses=max_poses), children, f"sweep {item.id}")
    info = sweep.info
    successes = info.outcomes.get("success", 0)
    console.print(
        f"Simulated {info.poses_done:,} poses"
        + (f" of the {info.full_grid_poses:,} of the full grid" if info.full_grid_poses else "")
        + f" in {duration(time.monotonic() - began)}: {_counts(info.outcomes)}."
    )
    if not successes:
        raise DemoFailed(f"no grasp of {info.poses_done:,} succeeded: raise --max-poses")
    density = item.refresh().density()
    kernel = density.kernel
    console.print(
        f"Density of {density.size:,} successes: {kernel.kind} kernel of"
        f" {kernel.sigma_position_m * 1000:.1f} mm and {kernel.sigma_rotation_deg:.1f}°"
        f" ({kernel.rule}), effective sample size {density.effective_sample_size:,.0f}."
    )
    overall = item.best_grasp()
    console.print(f"\n[bold]Best grasp overall[/]\n{_grasp(overall)}")
    said, within = _in_workspace(item, overall)
    console.print(f"\n{said}\n")
    _picture({"overall": overall, "workspace": within}, item.id, pictures, console)
    console.print(f"{_reports(item)}\n")
    shares = _check(item, children, console)
    return (
        f"[bold]{item.id}[/]: {successes:,} successes of {info.poses_done:,} poses.\n"
        f"  At the fine time step: {shares}."
    )


def _counts(outcomes: dict[str, int]) -> str:
    total = max(sum(outcomes.values()), 1)
    ordered = sorted(outcomes.items(), key=lambda pair: -pair[1])
    return ", ".join(f"{n:,} {name} ({100 * n / total:.2g} %)" for name, n in ordered if n)


def _grasp(grasp: Grasp) -> str:
    return "\n".join(f"  {escape(name)}: {escape(value)}" for name, value in grasp.summary().items())


def _in_workspace(item: GraspObject, overall: Grasp) -> tuple[str, Grasp | None]:
    """The best grasp of the object as it stands on a table, within the box that the gripper reaches, in words
    that say why it is not the best one ``overall``.
    """
    mesh = item.info.mesh
    height = 0.0 if mesh is None else -mesh.bounding_box.lower[2]
    half = math.radians(TURN_DEG) / 2
    pose = (0.5, 0.1, height, 0.0, 0.0, math.sin(half), math.cos(half))
    title = (
        f"[bold]Best grasp in a workspace[/]: standing on a table at x 0.5 m, y 0.1 m, turned by"
        f" {TURN_DEG:g}°; tool in the box {WORKSPACE_BOX[0]} to {WORKSPACE_BOX[1]} m, from above"
        f" within {WORKSPACE_CONE_DEG:g}°"
    )
    try:
        best = item.best_grasp(
            object_pose=pose,
            box=WORKSPACE_BOX,
            approach=WORKSPACE_APPROACH,
            approach_cone_deg=WORKSPACE_CONE_DEG,
        )
    except Infeasible as error:
        return f"{title}\n  {escape(str(error))}", None
    place = matrices(pose[:3], pose[3:]) @ overall.tool_matrix
    return f"{title}\n{_grasp(best)}\n  {_why_not(place)}", best


def _why_not(place: NDArray[np.float64]) -> str:
    """What of the workspace the tool (4, 4), in the world, is outside of."""
    away = math.degrees(math.acos(np.clip(place[:3, 2] @ np.array(WORKSPACE_APPROACH), -1.0, 1.0)))
    lower, upper = np.array(WORKSPACE_BOX)
    out = np.maximum(lower - place[:3, 3], place[:3, 3] - upper).max()
    broken = []
    if away > WORKSPACE_CONE_DEG:
        broken.append(f"approaches at {away:.0f}° to straight down ({WORKSPACE_CONE_DEG:g}° is allowed)")
    if out > 0.0:
        broken.append(f"has the tool {1000 * out:.0f} mm outside of the box")
    return (
        f"The best grasp overall {' and '.join(broken)}."
        if broken
        else "The best grasp overall lies within it, too."
    )


def _picture(grasps: Mapping[str, Grasp | None], name: str, folder: Path, console: Console) -> None:
    """Pictures of grasps, seen alike, where the service draws any and they can be kept."""
    drawn = []
    for title, grasp in grasps.items():
        target = folder / f"{name}-{title}.png"
        with contextlib.suppress(GraspDBError, OSError):
            if grasp is not None:
                folder.mkdir(exist_ok=True)
                target.write_bytes(grasp.picture(width=960, height=720, azimuth_deg=-60.0, elevation_deg=8.0))
                drawn.append(str(target))
    if drawn:
        console.print(f"Pictures of {'both' if len(drawn) == 2 else 'it'}: {escape(', '.join(drawn))}\n")


def _reports(item: GraspObject) -> str:
    """How far a grasp may be off and whether enough was tried, or what it takes to say so."""
    lines = []
    for title, ask in (("Tolerance", item.reports.anisotropy), ("Convergence", item.reports.convergence)):
        try:
            text = ask().text
        except Conflict as error:
            text = str(error)
        lines.append(f"[bold]{title}[/]: {escape(text)}")
    return "\n".join(lines)


def _check(item: GraspObject, children: Children, console: Console) -> str:
    """Simulate draws and best grasps at the fine time step; these outcomes enter no density."""
    draws = item.samples(DRAWS, seed=1)
    best = item.best_grasps(count=BEST)
    found = {}
    for title, poses in (("draws from the density", draws.matrices), ("best distinct grasps", best.matrices)):
        check = item.sweep(poses=poses, fidelity="fine", purpose="check")
        outcomes = _wait(check, children, f"check {title}").outcomes()
        found[title] = outcomes
        console.print(
            f"Of {len(outcomes)} {title}, simulated at the fine time step, {_share(outcomes)} hold."
        )
    shares = {title: float(np.mean(outcomes.success)) for title, outcomes in found.items()}
    top = shares["best distinct grasps"]
    if top < 0.8:
        console.print(
            f"[yellow]Expected of the best ones: at least 0.80. They reach {top:.2f}: with this many"
            " successes the density does not separate the grasps that hold well enough."
            " More --max-poses may help.[/]"
        )
    return "; ".join(
        f"{_share(outcomes)} of {len(outcomes)} {title} hold" for title, outcomes in found.items()
    )


def _share(outcomes: OutcomeArrays) -> str:
    count, total = int(outcomes.success.sum()), len(outcomes)
    low, high = wilson_interval(count, total)
    return f"{count} ({count / total:.2f}; {100 * LEVEL:.0f} % interval {low:.2f} to {high:.2f})"


def _view(db: Client, children: Children, name: str, console: Console) -> None:
    """The viewer beside the service, and where it is to be looked at."""
    port = _port(None, VIEWER_PORT)
    children.start("graspdb", "--url", db.url, "view", name, "--port", str(port))
    deadline = time.monotonic() + START_S
    while not _listens(port):
        children.check()
        if time.monotonic() > deadline:
            raise DemoFailed(f"no page in {START_S:g} s:\n{children.log('graspdb')}")
        time.sleep(0.1)
    console.print(f"[bold]Look at http://127.0.0.1:{port}[/] in a browser.")


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def _hold(db: Client, children: Children, name: str, console: Console) -> None:
    console.print(
        f"\nThe service goes on until Ctrl-C. In another terminal:\n"
        f"  export GRASPDB_URL={db.url}\n"
        f"  graspdb best-grasp {name} --approach 0,0,-1 --approach-cone-deg 45 --count 5\n"
        f"  curl '{db.url}/objects/{name}/best-grasp?approach=0,0,-1&approach_cone_deg=45'\n"
        f"and in a browser {db.url}/docs"
    )
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            children.check()
            time.sleep(0.5)
