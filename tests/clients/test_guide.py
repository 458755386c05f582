"""The pages' code, block by block as it stands there, against the real service and a real worker."""

from __future__ import annotations

import io
import re
import runpy
import shlex
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh
import yaml

import foreign_files as files
import known_robots
from graspdb import Client, wire
from graspdb.errors import NotFound
from graspdb.examples import example
from graspdb.figures.frames.gripper import draw_gripper
from graspdb.figures.grippers.explained import render_explained
from graspdb.interop.frames import to_tool
from graspdb.poses import as_poses, matrices
from graspdb.wire.presets.grippers import PRESETS
from pages import DOCS, ROOT, blocks, execute, pages, typed

URL = "http://127.0.0.1:8000"
DATABASE = "postgresql://user@host/graspdb"
GRIPPER = """<robot name="mine"><link name="base"><visual><origin xyz="0 0 0.03"/>
<geometry><box size="0.06 0.1 0.06"/></geometry></visual></link>{left}{right}</robot>"""
FINGER = """<link name="{name}"><visual><origin xyz="0 {middle} 0.025"/>
<geometry><box size="0.02 0.01 0.05"/></geometry></visual></link>
<joint name="{name}_joint" type="prismatic"><parent link="base"/><child link="{name}"/>
<origin xyz="0 0 0.06"/><axis xyz="0 {side} 0"/>
<limit lower="0" upper="0.04" effort="60" velocity="0.1"/>{mimic}</joint>"""


#: The concepts speak of trials, which a how-to posts.
GUIDE = sorted(
    (page for page in pages() if page.parent.name == "guide"), key=lambda page: page.stem != "trials"
)


class Robot:
    """What a reader has in place of it: takes a pose in the world."""

    def __init__(self) -> None:
        self.moved: list[np.ndarray] = []

    def move(self, pose: np.ndarray) -> None:
        self.moved.append(pose)


@pytest.mark.timeout(600)
def test_the_python_blocks_run(own_service_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "franka_panda").symlink_to(known_robots.PANDA.parent)
    parts = [trimesh.Trimesh(v, f) for v, f in example("mug").parts]
    cup = [trimesh.creation.box([40, 40, 60]), trimesh.creation.box([20, 20, 100])]
    trimesh.util.concatenate(cup).export(tmp_path / "cup.stl")
    for part in cup:
        part.apply_scale(1e-3)
    with Client(own_service_url) as db:
        mug, other = (
            db.objects.create(name, mesh=trimesh.util.concatenate(parts), convex_parts=parts, mass_kg=0.3)
            for name in ("mug", "other")
        )
        tried = mug.proposals(3_000, strategy="edges", gripper="panda", seed=7, sigma_position_m=0.005)
        mug.sweep(poses=tried, gripper="panda").wait()
        held = mug.trials.list(outcome="success").arrays()
        # Enough for every report that the guide asks for; a prior worth its name.
        assert held.success.sum() >= 300
        other.trials.add(held.matrices[:50], True, gripper="panda")
        some = tried.poses[:50]
        position, quaternion = as_poses(some)
        robot = Robot()
        names: dict[str, Any] = {
            "db": db,
            "mug": mug,
            "other": other,
            "part_1": cup[0],
            "part_2": cup[1],
            "poses": matrices(position, quaternion),
            "outcomes": ["success", "slipped"] * 25,
            "positions": position,
            "quaternions": quaternion,
            "held": [True, False] * 25,
            "slips": np.linspace(0.0, 0.02, 50),
            "T_world_mug": np.array([[1.0, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]]),
            "robot": robot,
        }
        found = [(page, *block) for page in GUIDE for block in blocks(page, "python")]
        assert len(found) >= 12
        acronym(db, tmp_path / "Mug_10f6.h5", matrices(position, quaternion))
        for page, line, block in found:
            # A block about the asynchronous client has its own.
            names |= {"db": db, "mug": mug}
            execute(page, line, block.replace(URL, own_service_url), names)
        assert names["cup"].info.convex_parts.parts == 2
        assert names["above"].approach[2] < -0.8
        assert names["beside"].approach[0] > 0.8
        (pose,) = robot.moved
        assert pose[2, 2] < -0.7
        assert (pose[:3, 3] >= [0.3, -0.2, 0.02]).all()
        assert 50 in {batch.inserted for batch in mug.batches}
        sweeps = [(sweep.info.poses, sweep.info.purpose) for sweep in mug.sweeps()]
        assert set(sweeps) >= {(3_000, "collect"), (200, "collect"), (10, "check"), (10, "collect")}
        # The other two are one with both engines.
        assert len(sweeps) == 6 + len(names["report"].calls)
        assert names["report"].recommended[0] > 0


def acronym(db: Client, path: Path, tools: np.ndarray) -> None:
    """A file of ACRONYM's with these poses (N, 4, 4) of a Panda's tool, every other of which held."""
    bases = tools @ np.linalg.inv(to_tool("base", "acronym", db.grippers.get("panda").profile))
    files.acronym_h5(path, bases, [i % 2 for i in range(len(bases))])


@pytest.fixture
def without_mug(db: Client) -> Iterator[None]:
    """The service has none, before and after: other tests type what makes one, too."""
    with suppress(NotFound):
        db.objects.get("mug").delete()
    yield
    db.objects.get("mug").delete()


@pytest.mark.usefixtures("worker", "without_mug")
def test_the_quick_start_runs(db: Client, tmp_path: Path) -> None:
    """As a newcomer types it, on an object that is not there before."""
    page = DOCS / "quick-start.md"
    said = [typed(block, tmp_path, GRASPDB_URL=db.url) for _, block in blocks(page, "bash")]
    assert len(said) == 4
    assert (tmp_path / "mug.png").stat().st_size > 10_000
    assert "flange" in said[2]
    ((line, block),) = blocks(page, "python")
    names: dict[str, Any] = {}
    execute(page, line, block.replace(URL, db.url), names)
    # The flange's place by Python is the one that the command line says.
    assert f"{names['best'].world[2, 3]:.4f}" in said[2]


@pytest.mark.usefixtures("without_mug")
def test_what_is_typed_about_grippers_and_files_runs(db: Client, tmp_path: Path) -> None:
    where = {"GRASPDB_URL": db.url}
    parts = [trimesh.Trimesh(v, f) for v, f in example("mug").parts]
    trimesh.util.concatenate(parts).export(tmp_path / "mug.obj")
    left = FINGER.format(name="left", side=1, middle=0.005, mimic="")
    right = FINGER.format(name="right", side=-1, middle=-0.005, mimic='<mimic joint="left_joint"/>')
    (tmp_path / "gripper.urdf").write_text(GRIPPER.format(left=left, right=right))
    known = db.add_example("mug")
    drawn = known.proposals(40, strategy="edges", gripper="panda", seed=1)
    acronym(db, tmp_path / "Mug_10f6.h5", matrices(*as_poses(drawn.poses)))
    for _, block in blocks(DOCS / "guide" / "grippers.md", "bash"):
        # Each block of the page makes a gripper of one's own.
        typed(block, tmp_path, **where)
        with suppress(NotFound):
            db.grippers.delete("mine")
    known.delete()
    first, *others = blocks(DOCS / "guide" / "import.md", "bash")
    assert "40 trials would be stored" in typed(first[1], tmp_path, **where)
    typed(first[1].replace(" --dry-run", "").replace("graspdb objects create", ": "), tmp_path, **where)
    for _, block in others:
        typed(block, tmp_path, **where)
    assert pq.read_table(tmp_path / "mug.parquet").num_rows == 40


@pytest.mark.parametrize("name", ["deploying", "operations"])
def test_what_is_typed_at_a_server_runs(name: str, empty_postgres_url: str, tmp_path: Path) -> None:
    found = blocks(DOCS / "guide" / f"{name}.md", "bash")
    assert found
    typed(f"graspdb-server migrate --database-url {empty_postgres_url}", tmp_path)
    for _, block in found:
        assert DATABASE in block
        typed(block.replace(DATABASE, empty_postgres_url), tmp_path)


def commands() -> list[str]:
    """What the pages tell to type: in blocks, in the text, and beside code."""
    found: set[str] = set()
    for page in pages():
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        blocks = re.findall(r"^```(?:bash|sh)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
        lines = [line.partition(" #")[0] for block in blocks for line in block.splitlines()]
        inline = re.findall(r"`(graspdb(?:-[a-z]+)? [^`]+)`", text)
        beside = re.findall(r"# (graspdb(?:-[a-z]+)? .+)$", text, re.MULTILINE)
        typed = [line.strip().partition(" > ")[0].removesuffix("&") for line in lines]
        found |= {" ".join(each.split()) for each in (*typed, *inline, *beside) if each.startswith("graspdb")}
    return sorted(found)


def test_the_commands_they_name_take_what_they_give_them(help_of: Callable[..., str]) -> None:
    named = commands()
    assert len(named) >= 40
    for command in named:
        assert "usage" in help_of(*shlex.split(command)).lower(), command


def test_the_compose_commands_name_what_there_is(help_of: Callable[..., str]) -> None:
    """``make test-compose`` runs them; here they are read."""
    told = [
        yaml.load((ROOT / name).read_text(encoding="utf-8"), _Compose)["services"]
        for name in ("compose.yaml", "deploy/replicas.yaml")
    ]
    services = {**told[0], **told[1]}
    profiles = {name for service in told[0].values() for name in service.get("profiles", [])}
    lines = [
        line
        for _, block in blocks(DOCS / "guide" / "compose.md", "sh")
        for line in block.splitlines()
        if "docker compose" in line
    ]
    assert len(lines) >= 15
    for line in lines:
        words = shlex.split(line, comments=True)[2:]
        while words[0] in ("--profile", "-f"):
            _, value, *words = words
            assert value in profiles or (ROOT / value).is_file(), line
        verb, *rest = words
        assert verb in ("up", "run", "build", "stop", "exec"), line
        scaled = [word.partition("=")[0] for word in rest if re.fullmatch(r"[a-z-]+=\d+", word)]
        assert set(scaled) <= services.keys(), line
        named = [word for word in rest if word in services]
        assert named or verb in ("up", "build"), line
        if "graspdb-server" in rest:
            command = rest[rest.index("graspdb-server") :]
            assert "usage" in help_of(*command).lower(), line


class _Compose(yaml.SafeLoader):
    """What compose adds to YAML."""


_Compose.add_constructor("!reset", lambda loader, node: None)


def _drawn(svg: bytes) -> tuple[list[str], np.ndarray]:
    """A figure's words, and the points of its lines and faces."""
    text = svg.decode()
    words = re.findall(r"<!-- (.*?) -->|<text[^>]*>([^<]*)<", text)
    paths = re.findall(r'<path d="([^"]*)" clip-path', text)
    numbers = re.findall(r"-?\d+\.?\d*", " ".join(paths))
    return ["".join(word) for word in words], np.array(numbers, dtype=np.float64)


@pytest.mark.parametrize("name", ["frames", "frames-of-a-grasp", "gripper-profile"])
def test_its_pictures_are_of_what_is_drawn_now(name: str) -> None:
    """The commands that the guide names beside them draw the same, to a tenth of a point."""
    panda = PRESETS["panda"].profile
    camera = wire.Pose(position=(0.06, 0.0, 0.02), quaternion_xyzw=(0.0, 0.0, 0.0, 1.0))
    if name == "gripper-profile":
        preset = PRESETS["robotiq-2f-85"]
        drawn = render_explained(preset.profile, preset.name, "svg")
    else:
        profile = panda.model_copy(update={"frames": panda.frames | {"camera": camera}})
        at = wire.Pose(position=(0.03, 0.1, 0.25), quaternion_xyzw=(1.0, 0.0, 0.0, 0.0))
        asked: dict[str, Any] = {"frame": "flange", "pose": at} if name == "frames-of-a-grasp" else {}
        target = io.BytesIO()
        draw_gripper("panda", profile, **asked).savefig(target, format="svg", metadata={"Date": None})
        drawn = target.getvalue()
    kept = (DOCS / "figures" / f"{name}.svg").read_bytes()
    (words, points), (kept_words, kept_points) = _drawn(drawn), _drawn(kept)
    assert words == kept_words
    np.testing.assert_allclose(points, kept_points, atol=0.1)


def test_the_picture_of_a_density_is_what_the_service_says_now(db: Client, fresh_id: str) -> None:
    script = DOCS / "figures" / "density_and_probability.py"
    target = io.BytesIO()
    drawn = runpy.run_path(str(script))["draw"](db, fresh_id)
    drawn.savefig(target, format="svg", metadata={"Date": None})
    (words, points), (kept_words, kept_points) = (
        _drawn(svg)
        for svg in (target.getvalue(), script.with_name("density-and-probability.svg").read_bytes())
    )
    assert words == kept_words
    np.testing.assert_allclose(points, kept_points, atol=0.5)
