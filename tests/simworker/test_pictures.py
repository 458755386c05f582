"""Drawing grasps: what `show` writes and says."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from graspdb.wire import Pose
from graspdb.wire.presets.grippers import PRESETS
from graspdb_simworker import cli
from graspdb_simworker.inspection import inputs, motions, pictures
from graspdb_simworker.simulation import chunks


def run(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "graspdb_simworker.cli", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_show_draws_the_grasp_it_simulates(tmp_path: Path) -> None:
    done = run("show", "mug", "--position", "0,0.028,0.035", "--quaternion", "1,0,0,0", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()[-1]
    assert said.startswith("success: fingers 0.00")
    # Flat pads touch the round wall of 4 mm in the middle outside and by their edges inside: 6.2 mm apart.
    assert float(said.split()[2]) == pytest.approx(0.0062, abs=3e-4)
    with Image.open(tmp_path / "grasp.png") as picture:
        assert picture.format == "PNG"
        image = np.asarray(picture)
    assert image.shape == (480, 1280, 3)
    # Both views show the orange mug, the dark fingers and the grey palm, before white.
    red, green, blue = (image[..., k].astype(int) for k in range(3))
    orange, dark = (red > green + 40) & (green > blue + 20), (red < 70) & (blue < 100)
    for half in (slice(0, 640), slice(640, 1280)):
        assert orange[:, half].mean() > 0.02
        assert dark[:, half].mean() > 0.005

    collision = run("show", "mug", "--position", "0,0,0.02", folder=tmp_path)
    assert collision.returncode == 0
    assert collision.stdout.splitlines()[-1].startswith("collision")


def test_show_names_what_is_wrong() -> None:
    for arguments, word in (
        (("show", "teapot"), "teapot"),
        (("show", "mug", "--quaternion", "1,0,0,1"), "norm"),
        (("verify", "mug", "--gripper", "claw"), "claw"),
        (("verify", "mug", "--protocol", "juggle"), "juggle"),
        (("verify", "--sweep", "abc"), "--url"),
        (("verify",), "name an object"),
    ):
        done = CliRunner().invoke(cli.app, arguments)
        assert done.exit_code == 1
        assert word in done.stderr
        assert "Traceback" not in done.stderr


def test_show_takes_the_service_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its objects and not the examples, which an empty address means."""
    monkeypatch.setenv("GRASPDB_URL", "http://127.0.0.1:9")
    done = CliRunner().invoke(cli.app, ["show", "teapot"])
    assert done.exit_code == 1
    assert "no answer from http://127.0.0.1:9" in done.stderr
    done = CliRunner().invoke(cli.app, ["show", "teapot", "--url", ""])
    assert "screwdriver" in done.stderr


def test_a_film_shows_the_object_swing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "FRAME_S", 0.2)  # a frame takes a second to draw
    film = tmp_path / "cone.gif"
    arguments = ["--quaternion", "0,0.70710678,0,0.70710678", "--protocol", "lift", "--out", str(film)]
    done = CliRunner().invoke(cli.app, ["show", "cone", *arguments])
    assert done.exit_code == 0, done.output
    # Held 7 cm beside its centre of mass, it turns in the jaw.
    assert done.stdout.splitlines()[-1].startswith(("slipped", "dropped"))
    with Image.open(film) as frames:
        assert frames.n_frames > 4  # type: ignore[attr-defined]
        first = np.asarray(frames.convert("RGB"), dtype=int)
        frames.seek(frames.n_frames - 1)  # type: ignore[attr-defined]
        last = np.asarray(frames.convert("RGB"), dtype=int)
    assert (np.abs(first - last).max(axis=2) > 60).mean() > 0.05


@pytest.mark.parametrize("protocol", ["wrench", "lift"])
def test_a_motion_is_that_of_the_label(tmp_path: Path, protocol: str) -> None:
    payload, parts = inputs.load("mug", "pg70", protocol=protocol)
    pose = Pose(position=(0.0, 0.028, 0.035), quaternion_xyzw=(1.0, 0.0, 0.0, 0.0))
    with closing(chunks.prepare(payload, parts)) as unwatched:
        position, quaternion = np.array([pose.position]), np.array([pose.quaternion_xyzw])
        _, travel = unwatched.classify(position, quaternion)
        label = unwatched.simulate(position[0], quaternion[0], float(travel[0]))
    moved = motions.motion(payload, parts, pose)
    # To the last bit: watching changes nothing.
    assert (moved["outcome"], moved["width_m"]) == (label.outcome.name.lower(), label.width_m)
    times, fingers = np.array(moved["times_s"]), np.array(moved["fingers_m"])
    assert times[0] == 0.0
    assert (np.diff(times) > 0).all()
    assert fingers[0].tolist() == [0.035, 0.035]
    # The way there is as fast as the fingers are; then the mug, held off its middle, moves in the jaw.
    assert times[1] == pytest.approx(
        (fingers[0, 0] - fingers[1, 0]) / payload.gripper.max_speed_m_s, rel=0.05
    )
    places = np.array(moved["position"])
    assert np.linalg.norm(places[1] - places[0]) < 2e-4
    assert np.linalg.norm(places[-1] - places[0]) > 2e-4
    assert np.linalg.norm(moved["quaternion_xyzw"], axis=1) == pytest.approx(1.0)


def test_a_motion_moves_the_finger_that_moved() -> None:
    payload, parts = inputs.load("cone", "pg70")
    for shift in (0.005, -0.005):
        # Beside the cone's axis: pushed by one finger, it ends beyond the middle, and the fingers with it.
        pose = Pose(position=(0.0, shift, 0.0), quaternion_xyzw=(0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)))
        moved = motions.motion(payload, parts, pose)
        ahead, behind = moved["fingers_m"][-1]
        assert abs(moved["position"][-1][1]) > 1e-3
        assert 0.5 * (ahead - behind) == pytest.approx(moved["position"][-1][1], abs=5e-4)


def test_a_motion_is_written_and_none_where_geometry_decides(tmp_path: Path) -> None:
    out = tmp_path / "motion.json"
    far = ["show", "mug", "--position", "0,0,1", "--out", str(out)]
    done = CliRunner().invoke(cli.app, far)
    assert done.exit_code == 0, done.output
    assert json.loads(out.read_text())["outcome"] == "missed"
    assert json.loads(out.read_text())["times_s"] == []


def test_pictures_are_written_as_they_are(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    assert pictures.write(tmp_path / "end.png", [image // 2, image]) == str(tmp_path / "end.png")
    with Image.open(tmp_path / "end.png") as written:
        np.testing.assert_array_equal(np.asarray(written), image)
    assert pictures.write(tmp_path / "none.gif", []) == ""


@pytest.mark.parametrize("gripper", sorted(PRESETS))
def test_a_gripper_is_known_without_a_service(gripper: str) -> None:
    payload, _ = inputs.load("cone", gripper)
    assert payload.gripper.max_opening_m == PRESETS[gripper].profile.max_opening_m
