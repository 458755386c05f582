"""The user guide's code, block by block as it stands there, against the real service and a real worker."""

from __future__ import annotations

import ast
import asyncio
import inspect
import io
import os
import re
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
import trimesh

from graspdb import Client, wire
from graspdb.examples import example
from graspdb.figures.frames.gripper import draw_gripper
from graspdb.figures.grippers.explained import render_explained
from graspdb.poses import as_poses, matrices
from graspdb.wire.presets.grippers import PRESETS

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "user-guide.md"
URL = "http://127.0.0.1:8000"


def blocks(language: str) -> list[tuple[int, str]]:
    """The blocks of a language with the line that each starts on."""
    text = GUIDE.read_text(encoding="utf-8")
    found = re.finditer(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return [(text[: match.start(1)].count("\n"), match.group(1)) for match in found]


def execute(line: int, block: str, names: dict[str, Any]) -> None:
    """Run a block in a namespace; errors name the guide's line."""
    code = compile("\n" * line + block, str(GUIDE), "exec", ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
    if code.co_flags & inspect.CO_COROUTINE:
        asyncio.run(types.FunctionType(code, names)())
    else:
        exec(code, names)  # noqa: S102 - the guide is ours


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
        found = blocks("python")
        assert len(found) >= 11
        for line, block in found:
            # A block about the asynchronous client has its own.
            names |= {"db": db, "mug": mug}
            execute(line, block.replace(URL, own_service_url), names)
        assert names["cup"].info.convex_parts.parts == 2
        assert names["above"].approach[2] < -0.8
        assert names["beside"].approach[0] > 0.8
        (pose,) = robot.moved
        assert pose[2, 2] < -0.7
        assert (pose[:3, 3] >= [0.3, -0.2, 0.02]).all()
        assert 50 in {batch.inserted for batch in mug.batches}
        sweeps = [(sweep.info.poses, sweep.info.purpose) for sweep in mug.sweeps()]
        assert set(sweeps) >= {(3_000, "collect"), (200, "collect"), (10, "check")}
        assert len(sweeps) == 3 + len(names["report"].calls)
        assert names["report"].recommended[0] > 0


def test_the_shell_blocks_run(empty_postgres_url: str, tmp_path: Path) -> None:
    found = blocks("bash")
    assert found
    for _, block in found:
        assert "postgresql://user@host/graspdb" in block
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        done = subprocess.run(
            ["sh", "-ec", block.replace("postgresql://user@host/graspdb", empty_postgres_url)],
            cwd=tmp_path,
            env={**os.environ, "PATH": path},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr


def commands() -> list[str]:
    """What the guide tells to type, in its text and beside its code."""
    text = GUIDE.read_text(encoding="utf-8")
    inline = re.findall(r"`(graspdb(?:-[a-z]+)? [^`]+)`", text)
    beside = re.findall(r"# (graspdb(?:-[a-z]+)? .+)$", text, re.MULTILINE)
    return sorted({" ".join(command.split()) for command in (*inline, *beside)})


def test_the_commands_it_names_take_what_it_gives_them(help_of: Callable[..., str]) -> None:
    named = commands()
    assert len(named) >= 10
    for command in named:
        assert "usage" in help_of(*command.split()).lower(), command


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
    kept = (GUIDE.parent / "figures" / f"{name}.svg").read_bytes()
    (words, points), (kept_words, kept_points) = _drawn(drawn), _drawn(kept)
    assert words == kept_words
    np.testing.assert_allclose(points, kept_points, atol=0.1)
