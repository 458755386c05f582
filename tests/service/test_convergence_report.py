"""The convergence report as trials come: extended where it can be, and the same as computed at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb.wire.reports import ConvergenceOptions
from graspdb_density import se3
from graspdb_density.statistics.incremental_bootstrap import IncrementalCurve
from graspdb_service.api.context import Context
from graspdb_service.settings import Settings
from graspdb_service.storage.database import Database
from graspdb_service.usecases.reports import convergence

Floats = NDArray[np.float64]
Poses = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]
Serve = Callable[..., str]


def _grasps(count: int) -> Poses:
    rng = np.random.default_rng(0)
    xi = rng.standard_normal((count, 6)) * np.array([0.03, 0.008, 0.02, 0.2, 0.6, 0.2])
    return xi[:, :3], se3.from_rotation_vector(xi[:, 3:])


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many grasps every curve took over from the one before; with few points, to be quick."""
    monkeypatch.setattr(convergence, "POINTS", 2_000)
    found: list[int] = []
    plain = IncrementalCurve.of

    def grown(*arguments: Any, **options: Any) -> IncrementalCurve:
        curve = plain(*arguments, **options)
        found.append(curve.kept)
        return curve

    monkeypatch.setattr(IncrementalCurve, "of", staticmethod(grown))
    return found


@pytest.fixture
def replicas(database_url: str, serve: Serve) -> Iterator[tuple[httpx.Client, httpx.Client]]:
    """Two service processes over one database."""
    with (
        httpx.Client(base_url=serve(database_url, report_wait_s=60), timeout=90) as one,
        httpx.Client(base_url=serve(database_url, report_wait_s=60), timeout=90) as other,
    ):
        yield one, other


def _at_once(url: str, **options: Any) -> dict[str, Any]:
    """The report as a process computes it that has nothing yet."""
    context = Context.create(Settings(database_url=url), Database(url))
    try:
        key = context.reports.key("thing", "convergence", ConvergenceOptions(**options))
        found = context.reports.compute("thing", key.parameters, lambda _: None)
    finally:
        context.close()
    return found.model_dump(mode="json")


def _assert_same(report: dict[str, Any], other: dict[str, Any]) -> None:
    """All that is said is the same, numbers within rounding."""

    def compared(a: Any, b: Any, name: str) -> None:
        if isinstance(a, dict):
            assert a.keys() == b.keys(), name
            for key in a:
                compared(a[key], b[key], key)
        elif isinstance(a, list):
            assert len(a) == len(b), name
            for x, y in zip(a, b, strict=True):
                compared(x, y, name)
        elif isinstance(a, float):
            assert a == pytest.approx(b, rel=1e-4, abs=1e-6), name
        else:
            assert a == b, name

    compared(report, other, "")
    for one, two in zip(report["curves"], other["curves"], strict=True):
        for a, b in zip(one["points"], two["points"], strict=True):
            assert a["similarity"] == pytest.approx(b["similarity"], abs=1e-6)


def test_new_trials_are_added_to_what_was_summed(
    replicas: tuple[httpx.Client, httpx.Client], database_url: str, make_object: Make, post: Post,
    kept: list[int],
) -> None:  # fmt: skip
    here, there = replicas
    make_object(here)
    p, q = _grasps(460)

    def posted(begin: int, end: int, outcome: str = "success", **more: Any) -> str:
        batch: str = post(here, "thing", (p[begin:end], q[begin:end]), outcome, **more)["batch"]
        return batch

    def asked(http: httpx.Client, extended: int) -> dict[str, Any]:
        kept.clear()
        answer = http.get("/objects/thing/reports/convergence")
        assert answer.status_code == 200, answer.text
        assert kept == [extended]
        report: dict[str, Any] = answer.json()
        _assert_same(report, _at_once(database_url))
        return report

    posted(0, 260)
    first = asked(here, 0)
    assert "Poisson" in first["method"]
    assert "first 200 in commit order" in first["method"]
    batch = posted(260, 300)
    assert asked(here, 260)["curves"][0]["verdict"]["grasps"] == 300
    # Another process begins with all of them, and goes on from there.
    posted(300, 301)
    asked(there, 0)
    posted(301, 340)
    asked(there, 301)
    # This one has missed a report.
    posted(340, 341)
    asked(here, 300)
    # Failures are another revision, and change no curve.
    posted(341, 345, "missed")
    asked(there, 340)
    # What is gone changes all that came after it.
    assert here.delete(f"/objects/thing/batches/{batch}").status_code == 204
    assert asked(here, 0)["curves"][0]["verdict"]["grasps"] == 301
    posted(345, 360)
    asked(here, 301)
    # At twice as many, widths and subsets are chosen anew.
    posted(360, 460)
    doubled = asked(here, 0)
    assert "first 400 in commit order" in doubled["method"]
    assert doubled["curves"][0]["kernel"] != first["curves"][0]["kernel"]
    # Who told no proposal density weighs as much as the rest in the mean: first all alike, then otherwise.
    posted(0, 5, proposal_density=[1.0, 2.0, 3.0, 4.0, 5.0])
    asked(here, 416)
    posted(5, 7, proposal_density=[1.0, 9.0])
    asked(here, 0)


@pytest.mark.parametrize(
    ("matching", "alignment"), [("determinants", "edge"), ("likelihood", "gripper"), ("likelihood", "object")]
)
def test_a_stored_kernels_curve_and_its_match_grow(
    sqlite_url: str, serve: Serve, make_object: Make, put_box: Callable[..., Any], post: Post,
    kept: list[int], matching: str, alignment: str,
) -> None:  # fmt: skip
    with httpx.Client(base_url=serve(sqlite_url, report_wait_s=60), timeout=90) as http:
        make_object(http)
        put_box(http, "thing", (0.06, 0.01, 0.03))
        p, q = _grasps(330)
        post(http, "thing", (p[:300], q[:300]))
        made = http.post("/kernels", json={"object": "thing", "alignment": alignment})
        assert made.status_code == 201, made.text
        kernel = made.json()["id"]
        for begin, end, extended in ((300, 300, [0, 0]), (300, 320, [300, 300]), (320, 330, [320, 320])):
            if end > begin:
                post(http, "thing", (p[begin:end], q[begin:end]))
            kept.clear()
            answer = http.get(f"/objects/thing/reports/convergence?kernel={kernel}&matching={matching}")
            assert answer.status_code == 200, answer.text
            assert kept == extended
            _assert_same(answer.json(), _at_once(sqlite_url, kernel=kernel, matching=matching))
