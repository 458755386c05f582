"""The command line ``graspdb-simworker``."""

from __future__ import annotations

import importlib
import importlib.util
import json
import logging
import math
import os
import signal
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, NamedTuple, NoReturn, cast

import typer
from rich.console import Console
from rich.progress import Progress

from graspdb.errors import GraspDBError
from graspdb.processes import LIFELINE_HELP, end_with_parent
from graspdb.transport import Transport
from graspdb.wire import Pose, SweepInfo
from graspdb.wire.sweeps import Engine
from graspdb_simworker.process.runner import ChunkRunner
from graspdb_simworker.simulation.engines import installed

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
    help="Simulates the grasps that a GraspDB service plans.",
)

log = logging.getLogger("graspdb.simworker")


def _require_physics(engine: str | None) -> Engine:
    """The engine asked for, or the default one; says in one line what is missing and leaves with code 2."""
    missing = [
        name for name in ("numba", "scipy", "manifold3d", "PIL") if importlib.util.find_spec(name) is None
    ]
    if missing:
        _leave(f"{', '.join(missing)} is missing: install the extra, `pip install 'graspdb[sim]'`")
    if engine is not None and engine not in installed.ENGINES:
        _leave(f"no engine {engine!r}; there are {', '.join(installed.ENGINES)}")
    try:
        return installed.require(engine)
    except installed.EngineMissing as error:
        _leave(str(error))


def _leave(message: str) -> NoReturn:
    typer.echo(f"graspdb-simworker: {message}", err=True)
    raise typer.Exit(2)


ObjectName = Annotated[
    str, typer.Argument(help="An object of the service, or without --url an example: cone, mug, ...")
]
ServiceUrl = Annotated[
    str | None,
    typer.Option(
        envvar="GRASPDB_URL", help="Take object and gripper from this service; --url '' means the examples."
    ),
]
GripperName = Annotated[str, typer.Option(help="A gripper of the service; without --url a built-in one.")]
ApiKey = Annotated[
    str | None, typer.Option(envvar="GRASPDB_API_KEY", help="With the scope jobs:work, to run; else read.")
]
Numbers = Annotated[str, typer.Option(help="Comma-separated, object frame.")]
EngineName = Annotated[
    str | None,
    typer.Option(
        "--engine",
        metavar="pybullet|mujoco",
        help="Physics engine: pybullet where it is installed, else mujoco.",
    ),
]
RunEngine = Annotated[
    str | None,
    typer.Option(
        "--engine",
        metavar="pybullet|mujoco|both",
        help="Physics engine of chunks that name none: pybullet where it is installed, else mujoco. Chunks"
        " that name one are taken for every engine that is installed; both asks for all of these.",
    ),
]
Protocol = Annotated[str, typer.Option(help="wrench, lift, shake, or as in shake-5-100.")]
DecomposeSeconds = Annotated[
    float,
    typer.Option(
        min=0,
        envvar="GRASPDB_DECOMPOSE_SECONDS",
        help="Processor time that the decomposition of a mesh into convex parts may take;"
        " 0 leaves them to other workers.",
    ),
]
DecomposeMemory = Annotated[
    int,
    typer.Option(min=1024, envvar="GRASPDB_DECOMPOSE_MEMORY_MIB", help="Address space of a decomposition."),
]
Processes = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=1024,
        help="Chunks simulated at once, one a core: 1 here, with --dask one a thread of the cluster.",
    ),
]
DaskAddress = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Simulate on the Dask cluster of this scheduler, not here."),
]


@app.command(epilog=LIFELINE_HELP)
def run(
    url: Annotated[str | None, typer.Option(envvar="GRASPDB_URL", help="The service's address.")] = None,
    processes: Processes = None,
    dask: DaskAddress = None,
    name: Annotated[str | None, typer.Option(help="As the service lists this worker.")] = None,
    exit_when_idle: Annotated[
        bool, typer.Option(help="Stop when there is nothing left to simulate.")
    ] = False,
    once: Annotated[bool, typer.Option(help="Stop after one job for each process.")] = False,
    engine: RunEngine = None,
    decompose_seconds: DecomposeSeconds = 120.0,
    decompose_memory_mib: DecomposeMemory = 4096,
    api_key: ApiKey = None,
    verbose: Annotated[bool, typer.Option(help="Say what is going on.")] = False,
) -> None:
    """Claim jobs, simulate them, hand in the results; until stopped, or idle if so asked.

    A chunk that names an installed engine is simulated with that one; --engine simulates the others.
    """
    chosen, engines = _engines(dask, engine)
    from graspdb_simworker.decomposition import supervisor as decomposition  # extra: sim
    from graspdb_simworker.loop import NoPhysics, Worker, WorkerFailed  # extra: sim

    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format="%(asctime)s %(levelname)s %(threadName)s %(message)s",
        stream=sys.stderr,
    )
    logging.getLogger("httpx").setLevel(logging.WARNING)
    limits = None
    if decompose_seconds > 0:
        if decomposition.available():
            limits = decomposition.ResourceLimits(decompose_seconds, decompose_memory_mib * 2**20)
        else:
            log.warning("coacd is missing: meshes of bodies that are not convex are left to other workers")

    with (
        _cluster(dask) as cluster,
        Transport(
            url, api_key=api_key, user_agent="graspdb-simworker", retries=0, timeout_s=30.0
        ) as transport,
    ):
        worker = Worker(
            transport,
            name=name or f"{socket.gethostname()}-{os.getpid()}",
            processes=processes or cluster.threads,
            exit_when_idle=exit_when_idle,
            once=once,
            make_runner=cluster.make_runner,
            decompositions=limits,
            engine=chosen,
            engines=engines,
        )
        _stop_on_signals(worker.stop)
        try:
            worker.run()
        except WorkerFailed as error:
            typer.echo(f"graspdb-simworker: {error}", err=True)
            raise typer.Exit(2 if isinstance(error, NoPhysics) else 1) from None
    typer.echo(str(worker.tally), err=True)


def _engines(dask: str | None, engine: str | None) -> tuple[Engine | None, Sequence[Engine]]:
    """The engine that simulates chunks that name none, and those that chunks may name."""
    if engine == "both":
        for name in () if dask is not None else installed.ENGINES:
            _require_physics(name)
        return (None if dask is not None else installed.ENGINES[0]), installed.ENGINES
    if dask is None:
        return _require_physics(engine), installed.names()
    # What a cluster has nobody here knows: it is taken at the word of whoever names an engine.
    chosen = cast("Engine | None", engine)
    return chosen, [] if chosen is None else [chosen]


class _Cluster(NamedTuple):
    """Where chunks are simulated: ``make_runner`` for each of ``threads`` at once."""

    threads: int
    make_runner: Callable[[], ChunkRunner]


@contextmanager
def _cluster(address: str | None) -> Iterator[_Cluster]:
    """This machine, or the Dask cluster of a scheduler."""
    from graspdb_simworker.process.local import LocalRunner  # extra: sim

    if address is None:
        yield _Cluster(1, LocalRunner)
        return
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        typer.echo(
            "graspdb-simworker: --dask needs the extra, `pip install 'graspdb[sim,dask]'`, here and on the"
            " cluster",
            err=True,
        )
        raise typer.Exit(2) from None
    from graspdb_simworker.process.executor import ExecutorRunner  # extra: sim

    try:
        client = distributed.Client(address, timeout=10)
    except (OSError, ValueError) as error:
        typer.echo(f"graspdb-simworker: no Dask scheduler at {address}: {error}", err=True)
        raise typer.Exit(1) from None
    with client, client.get_executor() as executor:
        yield _Cluster(max(1, sum(client.nthreads().values())), lambda: ExecutorRunner(executor))


@app.command()
def verify(
    object_name: ObjectName = "",
    count: Annotated[int, typer.Option(min=10, help="Grasps to simulate again.")] = 1000,
    gripper: GripperName = "pg70",
    protocol: Protocol = "wrench",
    engine: EngineName = None,
    sweep: Annotated[
        str | None, typer.Option(help="Verify what the service has stored of this sweep instead.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the sample.")] = 0,
    url: ServiceUrl = None,
    api_key: ApiKey = None,
) -> None:
    """Simulate a sample of the grid's physics poses at the fine step, 1/2000 s; print the agreement.

    With --sweep the sweep says which object, gripper, protocol and draws, and what is stored is compared;
    all of them are read to sample fairly, so a sweep of a random part of the grid (--max-poses) is
    verified sooner.
    """
    chosen = _require_physics(engine)
    from graspdb_simworker.inspection import agreement, inputs, stored_outcomes  # extra: sim

    with _explained():
        if sweep is not None:
            if not url:
                raise ValueError("--sweep needs --url or GRASPDB_URL, the service that has it")
            with _progress("poses read") as progress:
                info, stored = stored_outcomes.sample_of(
                    sweep, per_outcome=2 * count, url=url, api_key=api_key, seed=seed, progress=progress
                )
            object_name, gripper, protocol = info.object, info.gripper, info.protocol
            chosen = _engine_to_compare(info, engine)
            payload, parts = inputs.load(
                object_name, gripper, protocol=protocol, engine=chosen, url=url, api_key=api_key
            )
            payload = payload.model_copy(update={"randomise": info.randomise})
            with _progress("grasps") as progress:
                found = agreement.verify_stored(
                    payload, parts, stored, count=count, seed=seed, progress=progress
                )
        elif object_name:
            payload, parts = inputs.load(
                object_name,
                gripper,
                protocol=protocol,
                engine=chosen,
                url=url,
                api_key=api_key,
                seed=seed,
            )
            payload = agreement.enough_poses(payload, parts, count)
            with _progress("grasps") as progress:
                found = agreement.verify(payload, parts, count=count, seed=seed, progress=progress)
        else:
            raise ValueError("name an object, or a --sweep")
    typer.echo(found.summary(object_name))


def _engine_to_compare(info: SweepInfo, engine: str | None) -> Engine:
    """The engine asked for, or the one that simulated a sweep; says so and leaves if several did."""
    if engine is None and info.engines and info.sole_engine is None:
        _leave(f"{' and '.join(info.engines)} simulated this sweep: say with --engine which to compare")
    return _require_physics(engine or info.engine or info.sole_engine)


@app.command()
def show(
    object_name: ObjectName,
    position: Numbers = "0,0,0",
    quaternion: Annotated[str, typer.Option(help="x,y,z,w of the tool in the object frame.")] = "0,0,0,1",
    out: Annotated[
        Path, typer.Option(help="A .png of the end, a .gif of the whole, or a .json of its states.")
    ] = Path("grasp.png"),
    gripper: GripperName = "pg70",
    protocol: Protocol = "wrench",
    engine: EngineName = None,
    fine: Annotated[bool, typer.Option(help="The fine step, 1/2000 s.")] = False,
    url: ServiceUrl = None,
    api_key: ApiKey = None,
) -> None:
    """Simulate one grasp and draw it from two sides, seen from the jaw, or write what moved how.

    It is simulated once, of what object and gripper say: a sweep that draws friction, mass or noise anew for
    each simulation of a pose says in its outcomes how many of them succeeded.
    """
    end_with_parent()
    chosen = _require_physics(engine)
    from graspdb_simworker.inspection import inputs, motions, pictures  # extra: sim

    with _explained():
        pose = Pose.model_validate({"position": position, "quaternion_xyzw": quaternion})
        payload, parts = inputs.load(
            object_name, gripper, protocol=protocol, fine=fine, engine=chosen, url=url, api_key=api_key
        )
        if out.suffix.lower() == ".json":
            moved = motions.motion(payload, parts, pose)
            out.write_text(json.dumps(moved), encoding="utf-8")
            typer.echo(f"{moved['outcome']}: {len(moved['times_s'])} moments; {out}")
            return
        film_every_s = pictures.FRAME_S if out.suffix.lower() == ".gif" else math.inf
        shown = pictures.simulate_one(payload, parts, pose, film_every_s=film_every_s)
        # The outcome's name and the object's: what a picture is worth that went astray.
        outcome = shown.label.outcome.name.lower().replace("_", " ")
        written = pictures.write(out, shown.pictures, f"{object_name}, {gripper}, {protocol}: {outcome}")
    width, quality = (f"{v:.4g}" if v == v else "unknown" for v in (shown.label.width_m, shown.label.quality))
    meaning = (
        "times the weight held" if protocol == "wrench" else "(1: did not move in the jaw, below 0: too far)"
    )
    typer.echo(
        f"{shown.label.outcome.name.lower()}: fingers {width} m apart, quality {quality} {meaning};"
        f" {written or 'no picture: decided by the geometry'}"
    )


@contextmanager
def _explained() -> Iterator[None]:
    """One line for what a user can mend."""
    try:
        yield
    except (ValueError, GraspDBError) as error:
        typer.echo(f"graspdb-simworker: {error}", err=True)
        raise typer.Exit(1) from None


@contextmanager
def _progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on the standard error."""
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _stop_on_signals(stop: Callable[[], None]) -> None:
    def handle(number: int, frame: FrameType | None) -> None:
        # A second signal means it.
        signal.signal(number, signal.SIG_DFL)
        stop()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, handle)


def main() -> None:
    """Entry point."""
    end_with_parent()
    app()


if __name__ == "__main__":
    main()
