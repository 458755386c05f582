"""A small database in which every table has rows, as the service wrote them, and copies of either kind."""

from __future__ import annotations

import base64
import os
import re
import shutil
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from sqlalchemy import MetaData, inspect, select, types

from graspdb_geometry.grids import PoseGrid
from graspdb_service.storage.database import Database
from graspdb_service.storage.upkeep import backup
from graspdb_service.storage.upkeep.archive import ArchiveReader

SIZE_M = (0.04, 0.04, 0.10)
GRID = {"position_step_m": 0.02, "rotation_step_deg": 60.0, "margin_m": 0.0}
GRIPPER = {
    "id": "mine",
    "max_opening_m": 0.08,
    "finger": {"width_m": 0.02, "thickness_m": 0.01, "length_m": 0.05},
    "palm_size_m": [0.06, 0.2, 0.06],
}
POSTED = {"Idempotency-Key": "first-afternoon"}


def box_stl() -> bytes:
    corner = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * SIZE_M
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    content = b"".join(struct.pack("<12fH", 0, 0, 0, *corner[list(face)].ravel(), 0) for face in faces)
    return b"\0" * 80 + struct.pack("<I", len(faces)) + content


def trials(count: int = 300) -> dict[str, Any]:
    """Grasps of the box from above, most of which held; some with all that a trial can have."""
    rng = np.random.default_rng(7)
    listed = []
    for number in range(count):
        trial: dict[str, Any] = {
            "position": [*rng.normal(scale=0.004, size=2), 0.05 + rng.normal(scale=0.004)],
            "quaternion_xyzw": [1.0, 0.0, 0.0, 0.0],
            "outcome": "success" if number % 4 else "slipped",
        }
        if number % 7 == 0:
            trial |= {
                "quality": rng.random(),
                "qualities": {"flex": float(number % 2), "motion": rng.random()},
                "width_m": 0.04,
                "proposal_density": 1e3 * rng.random(),
                "measured_at": f"2026-03-01T12:{number % 60:02d}:00.000001Z",
                "metadata": {"operator": "Ørsted", "note": 'null "quoted"\n'},
                "pose_covariance": (np.eye(6) * 1e-6).tolist(),
            }
        listed.append(trial)
    told = {"licence": "CC-BY-4.0", "citation": "Doe 2020", "origin": {"file": "box.csv"}}
    return {"trials": listed, "gripper": "mine", "source": "robot", **told}


def simulate(payload: dict[str, Any]) -> dict[str, Any]:
    """A result as a worker makes it; outcomes depend on the pose index only."""
    index = PoseGrid(**payload["grid"]).pose_indices(payload["start"], payload["stop"])
    codes = np.array([1, 2, 2, 2, 4, 6, 2, 2], dtype=np.uint8)[(index * 2_654_435_761 >> 7) % 8]
    rows = index[codes != 2]
    widths = {"width_m": [0.04] * len(rows), "quality": [None] * len(rows)}
    return {
        "outcomes": base64.b64encode(codes.tobytes()).decode(),
        "rows": {"pose_index": rows.tolist(), **widths},
    }


def work(http: httpx.Client) -> None:
    """Do whatever jobs there are."""
    asked = {"worker": "w", "capabilities": ["simulate"], "limit": 5}
    while found := answered(http.post("/jobs/claim", json=asked))["jobs"]:
        for job in found:
            place = f"/jobs/{job['id']}/result", {"lease_id": job["lease_id"]}
            answered(http.put(place[0], params=place[1], json=simulate(job["payload"])))


def answered(answer: httpx.Response) -> Any:
    assert answer.is_success, answer.text
    return answer.json() if answer.content else None


def fill(http: httpx.Client) -> None:
    """Use everything that leaves rows behind."""
    answered(http.post("/grippers", json=GRIPPER))
    for slug in ("gone", "box"):
        answered(http.post("/objects", json={"id": slug, "mass_kg": 0.3, "metadata": {"shelf": 4}}))
        stl = {"content": box_stl(), "headers": {"Content-Type": "model/stl"}}
        answered(http.put(f"/objects/{slug}/mesh", **stl))
    answered(http.delete("/objects/gone"))
    answered(http.post("/objects/box/trials", json=trials(), headers=POSTED))
    again = answered(http.post("/objects/box/trials", json=trials()))
    assert again["findings"], "the same rows twice are a finding"
    answered(http.patch("/objects/box/trials/3", json={"outcome": "failure", "reason": "seen on the video"}))
    answered(http.delete("/objects/box/trials/5"))
    for options in ({"purpose": "collect"}, {"purpose": "check"}):
        answered(http.post("/objects/box/sweeps", json={"grid": GRID, "chunk_poses": 400, **options}))
        work(http)
    components = [{"covariance": np.diag([1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.01]).tolist()}]
    answered(http.post("/kernels", json={"components": components}))
    last = answered(http.post("/objects/box/trials", json=trials(2)))
    answered(http.delete(f"/objects/box/batches/{last['batch']}"))
    selected = {"gripper": "mine", "source": "robot", "collision_free": False, "name": "kept"}
    answered(http.get("/objects/box/best-grasp", params=selected))
    answered(http.get("/objects/box/reports/bandwidth", params={"gripper": "mine", "source": "robot"}))


def invented(database: Database) -> list[str]:
    """Put a made-up row into every table that has none: what a later version adds is tested as it comes."""
    found = MetaData()
    with database.write() as tx:
        found.reflect(tx)
        empty = [
            table
            for table in found.sorted_tables
            if table.name != "alembic_version" and tx.execute(select(table).limit(1)).first() is None
        ]
        for table in empty:
            allowed = _allowed(inspect(tx).get_check_constraints(table.name))
            row = {}
            for column in table.columns:
                reference = next(iter(column.foreign_keys), None)
                if reference is not None:
                    row[column.name] = tx.scalar(select(reference.column).limit(1))
                elif column.server_default is not None:
                    continue  # a number that the database gives, and goes on from
                elif column.name in allowed:
                    row[column.name] = allowed[column.name]
                else:
                    row[column.name] = _some(column.type)
            tx.execute(table.insert().values(row))
    return [table.name for table in empty]


def _allowed(constraints: list[Any]) -> dict[str, str]:
    """The first value that a constraint ``name IN ('a', ...)`` (or PostgreSQL's way to say it) admits."""
    found = {}
    for constraint in constraints:
        name, value = re.search(r"\(*(\w+)\)*.*?'(\w+)'", constraint["sqltext"]).groups()
        found[name] = value
    return found


def _some(kind: Any) -> Any:
    for known, value in (
        (types.LargeBinary, b"made up"),
        (types.DateTime, datetime(2026, 1, 2, tzinfo=UTC)),
        (types.JSON, {"made": "up"}),
        (types.Boolean, False),
        (types.Integer, 1),
        (types.Float, 0.5),
    ):
        if isinstance(kind, known):
            return value
    return "made up"[: getattr(kind, "length", None) or 7]


@pytest.fixture(scope="session")
def invent() -> Callable[[Database], list[str]]:
    """``invent(database)`` puts a row into every empty table; their names."""
    return invented


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory, serve_module: Callable[..., str]) -> Path:
    """A SQLite file as a service left it that was used for an afternoon."""
    folder = tmp_path_factory.mktemp("world")
    with httpx.Client(base_url=serve_module(f"sqlite:///{folder}/served.sqlite"), timeout=240) as http:
        fill(http)
    # One file without a journal beside it, which tests may copy.
    with closing(sqlite3.connect(folder / "served.sqlite")) as connection:
        connection.execute("VACUUM INTO ?", (str(folder / "graspdb.sqlite"),))
    with closing(sqlite3.connect(folder / "graspdb.sqlite")) as connection:
        connection.execute("PRAGMA journal_mode = WAL")
    database = Database(f"sqlite:///{folder / 'graspdb.sqlite'}")
    invented(database)
    database.dispose()
    return folder / "graspdb.sqlite"


@pytest.fixture(scope="module")
def world_backup(world: Path) -> Path:
    """That file's backup."""
    path = world.with_name("graspdb.backup")
    database = Database(f"sqlite:///{world}")
    backup.back_up(database, path, lambda *_: None)
    database.dispose()
    return path


@pytest.fixture
def reader(world_backup: Path) -> Iterator[ArchiveReader]:
    """The world's backup, open."""
    reader = ArchiveReader(world_backup)
    yield reader
    reader.close()


@pytest.fixture(params=["sqlite", "postgres"])
def empty_url(request: pytest.FixtureRequest) -> str:
    """A database without a schema, of either kind."""
    url: str = request.getfixturevalue(f"empty_{request.param}_url")
    return url


@pytest.fixture
def world_database(empty_url: str, reader: ArchiveReader) -> Iterator[Database]:
    """The world, restored into a database of this test's own of either kind."""
    database = Database(empty_url)
    backup.restore(database, reader, overwrite=False, progress=lambda *_: None)
    yield database
    database.dispose()


@pytest.fixture
def server() -> Callable[..., subprocess.CompletedProcess[str]]:
    """``server("doctor", ...)`` runs a command of graspdb-server."""

    def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "graspdb_service.cli", *arguments],
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )

    return run


@pytest.fixture
def damaged_copy(world_backup: Path, tmp_path: Path) -> Callable[..., Any]:
    """``with damaged_copy(change) as path``: the backup with its bytes changed."""

    @contextmanager
    def make(change: Callable[[bytearray], bytes | bytearray]) -> Iterator[Path]:
        path = tmp_path / "damaged.backup"
        shutil.copyfile(world_backup, path)
        path.write_bytes(change(bytearray(path.read_bytes())))
        yield path
        path.unlink()

    return make
