"""The densities kept by a service: made once, extended, rebuilt, bounded, never stale."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

import brute_force
from graspdb.wire.queries import TrialSelection
from graspdb_density import GraspDensity, IsotropicKernel, se3
from graspdb_service.api.context import Context
from graspdb_service.app import create_app
from graspdb_service.problems import ProblemError
from graspdb_service.settings import Settings
from graspdb_service.usecases.densities import cache as densities_module
from graspdb_service.usecases.densities.build import Built, KernelChoice
from graspdb_service.usecases.runtime.asked import Asked, begin
from graspdb_service.usecases.runtime.cache import SingleFlightCache

Floats = NDArray[np.float64]
Poses = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]

PLAIN = (TrialSelection(), KernelChoice(0.015, 15.0))
KERNEL = IsotropicKernel(0.015, np.deg2rad(15))


def density_of(ctx: Context, filters: TrialSelection, kernel: KernelChoice) -> Built:
    return ctx.densities.get(ctx.densities.selections.resolve("thing", filters), kernel)


def part(poses: Poses, start: int, stop: int) -> Poses:
    return poses[0][start:stop], poses[1][start:stop]


@pytest.fixture
def ctx(database_url: str, http: httpx.Client) -> Iterator[Context]:
    """The parts of a second service process over the database of ``http``."""
    context = create_app(Settings(database_url=database_url)).state.context
    yield context
    context.close()


# -- the cache by itself -----------------------------------------------------------------------------------


def test_single_flight() -> None:
    cache = SingleFlightCache[str, bytes](1000, len)
    made = []
    gate = threading.Event()

    def make(_: bytes | None) -> bytes:
        made.append(1)
        gate.wait(5)
        return b"value"

    with ThreadPoolExecutor(8) as pool:
        answers = [pool.submit(cache.get, "key", lambda _: True, make) for _ in range(8)]
        while not made:
            time.sleep(0.001)
        gate.set()
        assert {answer.result() for answer in answers} == {b"value"}
    assert len(made) == 1


def test_who_waits_for_what_another_makes_may_leave() -> None:
    cache = SingleFlightCache[str, bytes](1000, len)
    begun, gate = threading.Event(), threading.Event()

    def make(_: bytes | None) -> bytes:
        begun.set()
        gate.wait(60)
        return b"value"

    def late() -> bytes:
        begin(Asked("other", seconds=0.0))
        return cache.get("key", lambda _: True, make)

    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(cache.get, "key", lambda _: True, make)
        begun.wait(60)
        with pytest.raises(ProblemError) as found:
            pool.submit(late).result(30)
        gate.set()
        assert first.result() == b"value"
    assert found.value.kind == "deadline"


def test_a_failure_is_not_kept() -> None:
    cache = SingleFlightCache[str, bytes](1000, len)

    def fail(_: bytes | None) -> bytes:
        raise ValueError("no")

    with pytest.raises(ValueError):
        cache.get("key", lambda _: True, fail)
    assert cache.get("key", lambda _: True, lambda before: b"yes" if before is None else b"no") == b"yes"
    # What was there is kept where the next making fails.
    with pytest.raises(ValueError):
        cache.get("key", lambda _: False, fail)
    assert cache.get("key", lambda _: True, fail) == b"yes"


def test_least_recently_used_goes_first() -> None:
    cache = SingleFlightCache[str, bytes](100, len)
    made: list[str] = []

    def get(key: str, size: int = 40) -> None:
        def make(_: bytes | None) -> bytes:
            made.append(key)
            return bytes(size)

        cache.get(key, lambda _: True, make)

    get("a"), get("b"), get("a"), get("c")
    assert cache.nbytes == 80
    get("a")
    assert made == ["a", "b", "c"]
    get("b")
    assert made == ["a", "b", "c", "b"]
    # Too large to keep, but answered.
    get("huge", 500)
    assert made[-1] == "huge"
    assert cache.nbytes <= 100


# -- densities over a database -------------------------------------------------------------------------------


def test_concurrent_first_requests_build_once(
    http: httpx.Client,
    ctx: Context,
    make_object: Make,
    post: Post,
    two_clusters: Poses,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    make_object(http)
    post(http, "thing", two_clusters)
    builds = []
    build = densities_module.build.build

    def counted(*given: Any) -> Built:
        builds.append(1)
        time.sleep(0.05)
        return build(*given)

    monkeypatch.setattr(densities_module.build, "build", counted)
    with ThreadPoolExecutor(10) as pool:
        found = list(pool.map(lambda _: density_of(ctx, *PLAIN), range(10)))
    assert len(builds) == 1
    assert len({id(built) for built in found}) == 1
    # Named or not, the only gripper there is means the same density.
    named = density_of(ctx, TrialSelection(), KernelChoice(0.015, 15.0))
    assert named is found[0]


def test_extension_equals_rebuild_in_any_order_of_batches(
    http: httpx.Client,
    ctx: Context,
    make_object: Make,
    post: Post,
    two_clusters: Poses,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Batches with and without proposal densities and grippers, failures between; one reader keeps pace."""
    make_object(http)
    reads: list[int] = []
    read = densities_module.trial_rows.successes

    def watched(*given: Any, **more: Any) -> Any:
        reads.append(more["after_seq"])
        return read(*given, **more)

    monkeypatch.setattr(densities_module.trial_rows, "successes", watched)
    rng = np.random.default_rng(4)
    proposals: list[Floats] = []
    done = 0
    steps = [(120, None), (60, None), (1, 20.0), (100, 30.0), (80, 5.0), (39, None), (100, 12.0)]
    last_seq = 0
    for count, proposal in steps:
        poses = part(two_clusters, done, done + count)
        density = np.full(count, np.nan) if proposal is None else proposal * rng.uniform(0.5, 2, count)
        proposals.append(density)
        post(http, "thing", poses, proposal_density=density)
        post(http, "thing", part(two_clusters, 0, 10), "failure")
        done += count
        built = density_of(ctx, *PLAIN)
        assert reads[-1] == last_seq  # The tail only.
        last_seq = built.object_row.last_seq
        assert built.density is not None
        assert built.density.size == done
        known = np.concatenate(proposals)
        weights = np.ones(done)
        if not np.isnan(known).all():
            weights = np.where(np.isnan(known), np.nanmean(1 / known), 1 / known)
        trials = part(two_clusters, 0, done)
        fresh = GraspDensity.build(se3.Poses.of(*trials), kernel=KERNEL, weights=weights)
        np.testing.assert_allclose(
            built.density.log_density(se3.Poses.of(*two_clusters)),
            fresh.log_density(se3.Poses.of(*two_clusters)),
            atol=1e-5,
        )
        exact = brute_force.log_density(
            KERNEL, se3.Poses.of(*trials), se3.Poses.of(*two_clusters), weights=weights
        )
        np.testing.assert_allclose(
            built.density.log_density(se3.Poses.of(*two_clusters), cutoff=None), exact, atol=1e-4
        )
        np.testing.assert_allclose(built.density.weights, weights / weights.sum(), rtol=1e-9)
    assert len(reads) == len(steps)
    # Nothing new: not even the tail is read.
    assert density_of(ctx, *PLAIN) is built
    assert len(reads) == len(steps)


def test_default_widths_are_chosen_anew_only_when_successes_double(
    http: httpx.Client,
    ctx: Context,
    database_url: str,
    make_object: Make,
    post: Post,
    clusters: Callable[..., Poses],
) -> None:
    """A density that grew and one built at once agree on the widths, too."""
    make_object(http)
    rng = np.random.default_rng(6)
    centres = [(tuple(c), (1.0, 0.0, 0.0, 0.0)) for c in rng.uniform(-0.1, 0.1, (50, 3))]
    poses = clusters(centres, 20, sigma_m=0.004, sigma_rad=0.05)
    order = rng.permutation(1000)
    poses = poses[0][order], poses[1][order]
    seen = {}
    for start, stop in ((0, 150), (150, 199), (199, 260), (260, 399), (399, 401), (401, 700), (700, 1000)):
        post(http, "thing", part(poses, start, stop), proposal_density=rng.uniform(1, 3, stop - start))
        seen[stop] = density_of(ctx, TrialSelection(), KernelChoice()).kernel
        fresh = create_app(Settings(database_url=database_url)).state.context
        try:
            assert density_of(fresh, TrialSelection(), KernelChoice()).kernel == seen[stop]
        finally:
            fresh.close()
    assert (seen[150].sigma_position_m, seen[150].sigma_rotation_deg) == (0.015, 15)
    assert seen[150] == seen[199]
    assert "first 200" in seen[260].rule
    assert seen[260] == seen[399]
    assert "first 400" in seen[401].rule
    assert seen[401] == seen[700]
    assert "first 800" in seen[1000].rule
    # Clusters of 4 mm and 3 degrees: narrower than the first default.
    assert seen[1000].sigma_position_m < 0.015
    assert seen[1000].sigma_rotation_deg < 15


def test_what_one_process_commits_is_in_the_others_next_answer(
    database_url: str, serve: Callable[..., str], make_object: Make, post: Post, two_clusters: Poses
) -> None:
    with (
        httpx.Client(base_url=serve(database_url), timeout=60) as one,
        httpx.Client(base_url=serve(database_url), timeout=60) as two,
    ):
        make_object(one)
        batches = []
        for step in range(5):
            writer, reader = (one, two) if step % 2 else (two, one)
            receipt = post(writer, "thing", part(two_clusters, 100 * step, 100 * step + 100))
            batches.append(receipt["batch"])
            for client in (reader, writer):
                info = client.get("/objects/thing/density").json()
                assert (info["size"], info["revision"]) == (100 * step + 100, receipt["revision"])
        body = {
            "poses": {"position": two_clusters[0].tolist(), "quaternion_xyzw": two_clusters[1].tolist()},
            "kernel": {"sigma_position_m": 0.015, "sigma_rotation_deg": 15},
        }
        answers = [c.post("/objects/thing/likelihood", json=body).json()["log_density"] for c in (one, two)]
        np.testing.assert_allclose(answers[0], answers[1], atol=1e-5)

        # Deleting a batch through one rebuilds in the other.
        assert one.delete(f"/objects/thing/batches/{batches[1]}").status_code in (200, 204)
        left = np.r_[0:100, 200:500]
        exact = brute_force.log_density(
            KERNEL, se3.Poses.of(two_clusters[0][left], two_clusters[1][left]), se3.Poses.of(*two_clusters)
        )
        for client in (two, one):
            info = client.get("/objects/thing/density").json()
            assert info["size"] == 400
            assert info["epoch"] == info["revision"]
            answer = client.post("/objects/thing/likelihood", json=body).json()
            np.testing.assert_allclose(answer["log_density"], exact, atol=2e-3)


def test_attempts_through_one_process_are_in_the_others_next_chance(
    database_url: str, serve: Callable[..., str], make_object: Make, post: Post, two_clusters: Poses
) -> None:
    """Successes and failures alike: what either stores lowers or raises what both answer."""
    with (
        httpx.Client(base_url=serve(database_url), timeout=60) as one,
        httpx.Client(base_url=serve(database_url), timeout=60) as two,
    ):
        make_object(one)
        body = {
            "poses": {"position": [[0.0, 0.0, 0.06]], "quaternion_xyzw": [[1.0, 0.0, 0.0, 0.0]]},
            "kernel": {"sigma_position_m": 0.015, "sigma_rotation_deg": 15},
            "include": ["success_probability", "effective_trials"],
        }
        seen = []
        steps = [(one, "success"), (two, "failure"), (one, "slipped"), (two, "success"), (one, "collision")]
        for step, (writer, outcome) in enumerate(steps):
            post(writer, "thing", part(two_clusters, 50 * step, 50 * step + 50), outcome)
            answers = [client.post("/objects/thing/likelihood", json=body).json() for client in (two, one)]
            for name in ("success_probability", "effective_trials"):
                assert answers[0][name] == pytest.approx(answers[1][name], abs=1e-6)
            seen.append((answers[0]["success_probability"][0], answers[0]["effective_trials"][0]))
        chances = [chance for chance, _ in seen]
        assert chances[0] is None  # Only successes so far: no chance.
        assert chances[1] > chances[2] < chances[3] > chances[4]
        assert seen[1][1] < seen[2][1] < seen[3][1] < seen[4][1]


def test_a_new_object_of_the_same_name_has_nothing_of_the_old(
    http: httpx.Client, ctx: Context, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(http)
    post(http, "thing", two_clusters)
    old = density_of(ctx, *PLAIN)
    assert http.delete("/objects/thing").status_code == 204
    with pytest.raises(ProblemError) as caught:
        density_of(ctx, *PLAIN)
    assert caught.value.status == 404
    make_object(http)
    new = density_of(ctx, *PLAIN)
    assert new.density is None
    assert new.object_row.id != old.object_row.id


def test_readers_never_lose_or_double_a_trial_while_others_write(
    http: httpx.Client, ctx: Context, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(http)
    stop = threading.Event()
    wrong: list[str] = []

    def read() -> None:
        size = 0
        while not stop.is_set():
            built = density_of(ctx, *PLAIN)
            now = 0 if built.density is None else built.density.size
            if now < size or now != built.selected.successes or len(np.unique(built.seq)) != now:
                wrong.append(f"{now} after {size}, {built.selected.successes} counted")
            size = now

    readers = [threading.Thread(target=read) for _ in range(3)]
    for reader in readers:
        reader.start()
    with ThreadPoolExecutor(4) as writers:
        for answer in [
            writers.submit(post, http, "thing", part(two_clusters, i, i + 20)) for i in range(0, 500, 20)
        ]:
            answer.result()
    stop.set()
    for reader in readers:
        reader.join()
    assert wrong == []
    final = density_of(ctx, *PLAIN)
    assert final.density is not None
    assert final.density.size == 500


def test_the_cache_is_bounded_by_bytes(
    database_url: str, http: httpx.Client, make_object: Make, post: Post, clusters: Callable[..., Poses]
) -> None:
    make_object(http)
    post(http, "thing", clusters([((0, 0, 0), (0, 0, 0, 1.0))], 4000))
    settings = Settings(database_url=database_url, max_density_cache_bytes=2**21)
    context = create_app(settings).state.context
    try:
        widths = [0.01 + 0.001 * i for i in range(12)]
        for width in widths:
            built = density_of(context, TrialSelection(), KernelChoice(width, 15.0))
            assert built.density is not None
            assert context.densities.kept.nbytes <= 2**21
        assert 1 <= len(context.densities.kept) < len(widths)
        again = density_of(context, TrialSelection(), KernelChoice(widths[-1], 15.0))
        assert again is built
        # Models of success have a bound of their own, of the same kind.
        post(http, "thing", clusters([((0, 0, 0), (0, 0, 0, 1.0))], 2000, seed=1), "failure")
        for width in widths[:6]:
            built = density_of(context, TrialSelection(), KernelChoice(width, 15.0))
            assert context.successes.model(built, collisions_known=False) is not None
            assert context.successes.kept.nbytes <= settings.max_density_cache_bytes
    finally:
        context.close()
