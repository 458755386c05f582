"""Widths that rows choose by themselves: found once, for every replica and after a restart."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from sqlalchemy import func, select

from graspdb_density.se3 import Poses
from graspdb_service.storage.database import Database
from graspdb_service.storage.tables import width_choices
from graspdb_service.usecases.densities.widths import choosing

Serve = Callable[..., str]


@pytest.fixture
def chosen(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """From how many rows widths were chosen, each time that they were."""
    found: list[int] = []
    choose = choosing.choose_widths

    def counting(rows: Any, *, threads: int = 1) -> Any:
        found.append(len(rows))
        return choose(rows, threads=threads)

    monkeypatch.setattr(choosing, "choose_widths", counting)
    return found


def columns(count: int, seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    turns = rng.normal((1, 0, 0, 0), 0.2, (count, 4))
    return {
        "position": rng.normal(0, 0.03, (count, 3)).tolist(),
        "quaternion_xyzw": (turns / np.linalg.norm(turns, axis=1)[:, None]).tolist(),
        "outcome": [True] * count,
    }


def post(http: httpx.Client, count: int, seed: int) -> str:
    told = {"columns": columns(count, seed), "gripper": "pg70"}
    answer = http.post("/objects/cup/trials", json=told)
    assert answer.status_code == 201, answer.text
    batch: str = answer.json()["batch"]
    return batch


def kept(database_url: str) -> int:
    database = Database(database_url)
    try:
        with database.read() as tx:
            return tx.execute(select(func.count()).select_from(width_choices)).scalar_one()
    finally:
        database.dispose()


def test_the_same_rows_choose_once_for_all_replicas_and_after_a_change_of_the_past(
    database_url: str, serve: Serve, chosen: list[int], eventually: Callable[..., Any]
) -> None:
    with httpx.Client(base_url=serve(database_url), timeout=60) as here:
        here.post("/objects", json={"id": "cup"}).raise_for_status()
        post(here, 250, seed=0)
        later = post(here, 20, seed=1)
        chosen.clear()  # what a service does when it starts
        first = here.get("/objects/cup/density").json()["kernel"]
        assert chosen == [200]
        eventually(lambda: kept(database_url) == 1)
        with httpx.Client(base_url=serve(database_url), timeout=60) as there:
            chosen.clear()
            assert there.get("/objects/cup/density").json()["kernel"] == first
            # Built anew from rows whose first 200 are the same ones, by both.
            there.delete(f"/objects/cup/batches/{later}").raise_for_status()
            assert here.get("/objects/cup/density").json()["kernel"] == first
            assert there.get("/objects/cup/density").json()["kernel"] == first
            assert chosen == []
            # One of the 200 is withdrawn: others choose.
            there.delete("/objects/cup/trials/1").raise_for_status()
            here.get("/objects/cup/density").raise_for_status()
            assert chosen == [200]
            there.delete("/objects/cup").raise_for_status()
            eventually(lambda: kept(database_url) == 0)


def test_a_choice_of_an_object_that_is_gone_or_of_a_database_that_is_down_is_given_and_not_kept(
    sqlite_url: str,
) -> None:
    database = Database(sqlite_url)
    widths = choosing.WidthChoosing(database)
    rng = np.random.default_rng(0)
    poses = choosing.Rows.of(_poses(rng, 200))
    found = widths.choose(7, poses, threads=1)
    database.down = lambda: "no reason"
    assert widths.choose(7, poses, threads=1) == found
    widths.close()
    assert kept(sqlite_url) == 0
    database.dispose()


def test_an_object_keeps_its_newest_choices(sqlite_url: str, serve: Serve) -> None:
    with httpx.Client(base_url=serve(sqlite_url), timeout=60) as http:
        http.post("/objects", json={"id": "cup"}).raise_for_status()
    database = Database(sqlite_url)
    with database.write() as tx:
        for number in range(100):
            told = choosing.ChosenWidths(0.01, 0.2, "default")
            choosing.width_choices.add(tx, 1, f"{number:064}", told)
    with database.read() as tx:
        digests = tx.execute(select(width_choices.c.digest).order_by(width_choices.c.number)).scalars().all()
    assert [int(digest) for digest in digests] == list(range(36, 100))
    database.dispose()


def _poses(rng: np.random.Generator, count: int) -> Poses:
    turns = rng.normal((1, 0, 0, 0), 0.2, (count, 4))
    return Poses(rng.normal(0, 0.03, (count, 3)), turns / np.linalg.norm(turns, axis=1)[:, None])
