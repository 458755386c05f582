"""The asynchronous client: ``async with AsyncClient() as db: best = await db.objects.get("mug")``.

Every class mirrors one of the synchronous client under the same names: what asks the service is awaited,
what lists is iterated with ``async for``. The work is the synchronous client's, in a bounded number of
threads, so that there is one SDK to trust. A task that is cancelled returns at once; the request it waited
for ends by itself.
"""

from __future__ import annotations

import functools
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator
from itertools import islice
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, cast

import anyio
import anyio.to_thread

from graspdb import wire
from graspdb.client import Client
from graspdb.reports import AllReports, Reports
from graspdb.resources.access.audit import Audit
from graspdb.resources.access.keys import Keys
from graspdb.resources.answers import Answers
from graspdb.resources.cells.robots import Robots
from graspdb.resources.cells.scenes import Scenes
from graspdb.resources.grippers import Grippers
from graspdb.resources.kernels import Kernels
from graspdb.resources.objects import GraspObject, Objects
from graspdb.resources.pages import PAGE, Item, Listing
from graspdb.resources.sweeps import ProgressCallback, Sweep, Sweeps
from graspdb.resources.trials import Batches, TrialListing, Trials

S = TypeVar("S")
Sync = TypeVar("Sync", covariant=True)
R = TypeVar("R")
M = TypeVar("M")
P = ParamSpec("P")
A = TypeVar("A", bound="Mirror[Any]")


async def _in_thread(call: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    return await anyio.to_thread.run_sync(functools.partial(call, *args, **kwargs), abandon_on_cancel=True)


async def _each(items: Iterable[R]) -> AsyncIterator[R]:
    """A page at a time, so that a thread is entered once a request and not once an item."""
    iterator: Iterator[R] = iter(items)
    while page := await _in_thread(lambda: list(islice(iterator, PAGE))):
        for item in page:
            yield item


def _same(item: R) -> R:
    return item


class Mirror(Generic[Sync]):
    """The asynchronous side of ``sync``, an object of the synchronous client."""

    def __init__(self, sync: Sync) -> None:
        self.sync = sync

    def __repr__(self) -> str:
        return f"Async{self.sync!r}"


class _Attribute(Generic[S, R]):
    """An attribute of the synchronous object."""

    def __init__(self, read: Callable[[S], R]) -> None:
        self._read = read

    def __get__(self, mirror: Any, owner: type[Any]) -> R:
        return self._read(mirror.sync) if mirror is not None else cast("R", self)


def _mirrored(
    method: Callable[Concatenate[S, P], R], mirror: Callable[[R], M]
) -> Callable[Concatenate[Mirror[S], P], Awaitable[M]]:
    """The method in a thread, its answer mirrored."""

    async def call(self: Mirror[S], /, *args: P.args, **kwargs: P.kwargs) -> M:
        return mirror(await _in_thread(method, self.sync, *args, **kwargs))

    functools.update_wrapper(call, method)
    return call


def _awaited(method: Callable[Concatenate[S, P], R]) -> Callable[Concatenate[Mirror[S], P], Awaitable[R]]:
    """The method in a thread."""
    return _mirrored(method, _same)


def _chained(method: Callable[Concatenate[Any, P], Any]) -> Callable[Concatenate[A, P], Awaitable[A]]:
    """A method that changes its object and gives it back, in a thread."""

    async def call(self: A, /, *args: P.args, **kwargs: P.kwargs) -> A:
        await _in_thread(method, self.sync, *args, **kwargs)
        return self

    functools.update_wrapper(call, method)
    return call


def _at_once(
    method: Callable[Concatenate[S, P], R], mirror: Callable[[R], M]
) -> Callable[Concatenate[Mirror[S], P], M]:
    """A method that asks the service nothing, its answer mirrored."""

    def call(self: Mirror[S], /, *args: P.args, **kwargs: P.kwargs) -> M:
        return mirror(method(self.sync, *args, **kwargs))

    functools.update_wrapper(call, method)
    return call


def _iterated(
    method: Callable[Concatenate[S, P], Iterable[R]], mirror: Callable[[R], M]
) -> Callable[Concatenate[Mirror[S], P], AsyncIterator[M]]:
    """What the method lists, each item mirrored."""

    async def call(self: Mirror[S], /, *args: P.args, **kwargs: P.kwargs) -> AsyncIterator[M]:
        async for item in _each(await _in_thread(method, self.sync, *args, **kwargs)):
            yield mirror(item)

    functools.update_wrapper(call, method)
    return call


class AsyncSweep(Mirror[Sweep]):
    """:class:`graspdb.resources.sweeps.Sweep`."""

    info = _Attribute[Sweep, wire.SweepInfo](lambda sweep: sweep.info)
    id = _Attribute[Sweep, str](lambda sweep: sweep.id)
    state = _Attribute[Sweep, str](lambda sweep: sweep.state)
    finished = _Attribute[Sweep, bool](lambda sweep: sweep.finished)
    refresh = _chained(Sweep.refresh)
    cancel = _chained(Sweep.cancel)
    retry = _chained(Sweep.retry)
    waits_for = _awaited(Sweep.waits_for)
    hint = _awaited(Sweep.hint)
    linked = _mirrored(Sweep.linked, lambda other: None if other is None else AsyncSweep(other))
    outcomes = _awaited(Sweep.outcomes)

    async def wait(
        self, *, progress: bool | ProgressCallback = False, timeout: float | None = None
    ) -> AsyncSweep:
        """As :meth:`graspdb.resources.sweeps.Sweep.wait`; no thread waits meanwhile."""
        pauses = self.sync.pauses(progress=progress, timeout=timeout)
        while (pause := await _in_thread(next, pauses, None)) is not None:
            await anyio.sleep(pause)
        return self


class AsyncSweeps(Mirror[Sweeps]):
    """:class:`graspdb.resources.sweeps.Sweeps`."""

    get = _mirrored(Sweeps.get, AsyncSweep)
    list = _iterated(Sweeps.list, AsyncSweep)


class AsyncListing(Mirror[Listing[Item]], Generic[Item]):
    """:class:`graspdb.resources.pages.Listing`: ``async for``, or :meth:`first`."""

    def __aiter__(self) -> AsyncIterator[Item]:
        return _each(self.sync)

    async def first(self, count: int) -> list[Item]:
        """At most the first ``count`` items."""
        return await _in_thread(self.sync.first, count)


class AsyncTrialListing(AsyncListing[wire.TrialOut]):
    """:class:`graspdb.resources.trials.TrialListing`."""

    sync: TrialListing

    documents = _iterated(TrialListing.documents, _same)
    arrays = _awaited(TrialListing.arrays)
    to_pandas = _awaited(TrialListing.to_pandas)


class AsyncTrials(Mirror[Trials]):
    """:class:`graspdb.resources.trials.Trials`."""

    add = _awaited(Trials.add)
    add_records = _awaited(Trials.add_records)
    add_columns = _awaited(Trials.add_columns)
    get = _awaited(Trials.get)
    withdraw = _awaited(Trials.withdraw)
    correct = _awaited(Trials.correct)
    to_pandas = _awaited(Trials.to_pandas)
    list = _at_once(Trials.list, AsyncTrialListing)
    __aiter__ = _iterated(Trials.list, _same)


class AsyncBatches(Mirror[Batches]):
    """:class:`graspdb.resources.trials.Batches`."""

    get = _awaited(Batches.get)
    delete = _awaited(Batches.delete)
    list = _at_once(Batches.list, AsyncListing[wire.BatchInfo])
    __aiter__ = _iterated(Batches.list, _same)


class AsyncReports(Mirror[Reports]):
    """:class:`graspdb.reports.Reports`."""

    convergence = _awaited(Reports.convergence)
    anisotropy = _awaited(Reports.anisotropy)
    calibration = _awaited(Reports.calibration)
    projection = _awaited(Reports.projection)
    bandwidth = _awaited(Reports.bandwidth)
    kernel_similarity = _awaited(Reports.kernel_similarity)
    sources = _awaited(Reports.sources)
    promises = _awaited(Reports.promises)
    engines = _awaited(Reports.engines)
    simulate = _mirrored(Reports.simulate, lambda sweeps: [AsyncSweep(sweep) for sweep in sweeps])


class AsyncAllReports(Mirror[AllReports]):
    """:class:`graspdb.reports.AllReports`."""

    summary = _awaited(AllReports.summary)


class AsyncGraspObject(Mirror[GraspObject]):
    """:class:`graspdb.resources.objects.GraspObject`."""

    def __init__(self, sync: GraspObject) -> None:
        super().__init__(sync)
        self.trials = AsyncTrials(sync.trials)
        self.batches = AsyncBatches(sync.batches)
        self.reports = AsyncReports(sync.reports)

    info = _Attribute[GraspObject, wire.ObjectInfo](lambda item: item.info)
    id = _Attribute[GraspObject, str](lambda item: item.id)
    summary = _at_once(GraspObject.summary, _same)
    refresh = _chained(GraspObject.refresh)
    patch = _chained(GraspObject.patch)
    copy = _mirrored(GraspObject.copy, lambda item: AsyncGraspObject(item))
    delete = _awaited(GraspObject.delete)
    upload_mesh = _awaited(GraspObject.upload_mesh)
    download_mesh = _awaited(GraspObject.download_mesh)
    mesh_triangles = _awaited(GraspObject.mesh_triangles)
    upload_convex_parts = _awaited(GraspObject.upload_convex_parts)
    download_convex_parts = _awaited(GraspObject.download_convex_parts)
    density = _awaited(GraspObject.density)
    likelihood = _awaited(GraspObject.likelihood)
    best_grasp = _awaited(GraspObject.best_grasp)
    best_grasps = _awaited(GraspObject.best_grasps)
    picture = _awaited(GraspObject.picture)
    samples = _awaited(GraspObject.samples)
    reach = _awaited(GraspObject.reach)
    proposals = _awaited(GraspObject.proposals)
    answers = _at_once(GraspObject.answers, AsyncListing[wire.AnswerInfo])
    sweep = _mirrored(GraspObject.sweep, AsyncSweep)
    sweeps = _iterated(GraspObject.sweeps, AsyncSweep)


class AsyncObjects(Mirror[Objects]):
    """:class:`graspdb.resources.objects.Objects`."""

    create = _mirrored(Objects.create, AsyncGraspObject)
    get = _mirrored(Objects.get, AsyncGraspObject)
    list = _iterated(Objects.list, AsyncGraspObject)
    delete = _awaited(Objects.delete)
    __aiter__ = list


class AsyncGrippers(Mirror[Grippers]):
    """:class:`graspdb.resources.grippers.Grippers`."""

    create = _awaited(Grippers.create)
    update = _awaited(Grippers.update)
    versions = _iterated(Grippers.versions, _same)
    get = _awaited(Grippers.get)
    delete = _awaited(Grippers.delete)
    list = _iterated(Grippers.list, _same)
    __aiter__ = list


class AsyncRobots(Mirror[Robots]):
    """:class:`graspdb.resources.cells.robots.Robots`."""

    put = _awaited(Robots.put)
    get = _awaited(Robots.get)
    shape = _awaited(Robots.shape)
    description = _awaited(Robots.description)
    update = _awaited(Robots.update)
    delete = _awaited(Robots.delete)
    list = _iterated(Robots.list, _same)
    __aiter__ = list


class AsyncScenes(Mirror[Scenes]):
    """:class:`graspdb.resources.cells.scenes.Scenes`."""

    put = _awaited(Scenes.put)
    get = _awaited(Scenes.get)
    delete = _awaited(Scenes.delete)
    list = _iterated(Scenes.list, _same)
    __aiter__ = list


class AsyncAnswers(Mirror[Answers]):
    """:class:`graspdb.resources.answers.Answers`."""

    get = _awaited(Answers.get)
    delete = _awaited(Answers.delete)
    list = _at_once(Answers.list, AsyncListing[wire.AnswerInfo])


class AsyncKernels(Mirror[Kernels]):
    """:class:`graspdb.resources.kernels.Kernels`."""

    fit = _awaited(Kernels.fit)
    create = _awaited(Kernels.create)
    get = _awaited(Kernels.get)
    list = _iterated(Kernels.list, _same)
    delete = _awaited(Kernels.delete)
    __aiter__ = list


class AsyncKeys(Mirror[Keys]):
    """:class:`graspdb.resources.access.Keys`."""

    create = _awaited(Keys.create)
    rotate = _awaited(Keys.rotate)
    revoke = _awaited(Keys.revoke)
    list = _iterated(Keys.list, _same)
    __aiter__ = list


class AsyncAudit(Mirror[Audit]):
    """:class:`graspdb.resources.access.Audit`."""

    list = _at_once(Audit.list, AsyncListing[wire.AuditEntry])
    __aiter__ = _iterated(Audit.list, _same)


class AsyncClient(Mirror[Client]):
    """:class:`graspdb.client.Client` for asynchronous programs; takes the same parameters."""

    def __init__(
        self,
        url: str | None = None,
        *,
        api_key: str | None = None,
        timeout_s: float = 120.0,
        retries: int = 5,
    ) -> None:
        super().__init__(Client(url, api_key=api_key, timeout_s=timeout_s, retries=retries))
        self.objects = AsyncObjects(self.sync.objects)
        self.grippers = AsyncGrippers(self.sync.grippers)
        self.robots = AsyncRobots(self.sync.robots)
        self.scenes = AsyncScenes(self.sync.scenes)
        self.kernels = AsyncKernels(self.sync.kernels)
        self.sweeps = AsyncSweeps(self.sync.sweeps)
        self.answers = AsyncAnswers(self.sync.answers)
        self.keys = AsyncKeys(self.sync.keys)
        self.audit = AsyncAudit(self.sync.audit)
        self.reports = AsyncAllReports(self.sync.reports)

    url = _Attribute[Client, str](lambda client: client.url)
    info = _awaited(Client.info)
    ready = _awaited(Client.ready)
    workers = _awaited(Client.workers)
    add_example = _mirrored(Client.add_example, AsyncGraspObject)
    close = _awaited(Client.close)

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.sync.close()
