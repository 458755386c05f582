"""The ``graspdb`` command against the real service."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
import trimesh

from graspdb.options import Corners
from graspdb.resources.kernels import KernelOptions
from graspdb.resources.objects import ObjectProperties
from graspdb.resources.selection import Constraints, Selection
from graspdb.resources.sweeps import SweepOptions
from graspdb.resources.trials import TrialFilters, Upload

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def trials_file(tmp_path: Path, clusters: Callable[..., np.ndarray]) -> str:
    """CSV with successes about two poses."""
    poses = clusters([([0, 0, 0.06], [1, 0, 0, 0]), ([-0.08, 0, 0], [0, 0.5**0.5, 0, 0.5**0.5])], 60)
    path = tmp_path / "trials.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["x", "y", "z", "qx", "qy", "qz", "qw", "outcome"])
        writer.writerows([*row, "success"] for row in poses.tolist())
    return str(path)


def test_objects_from_creation_to_deletion(run: Run, fresh_id: str, tmp_path: Path) -> None:
    mesh = tmp_path / "box.stl"
    trimesh.creation.box((40, 60, 100)).export(mesh)
    code, out, _ = run("objects", "create", fresh_id, "--mesh", str(mesh), "--unit", "mm", "--mass-kg", "0.2")
    assert code == 0
    assert "40.0 x 60.0 x 100.0 mm" in out
    assert fresh_id in run("objects", "list")[1]
    code, out, _ = run("--json", "objects", "show", fresh_id)
    assert json.loads(out)["mass_kg"] == 0.2
    assert run("objects", "delete", fresh_id, "--yes")[0] == 0
    code, out, err = run("objects", "show", fresh_id)
    assert (code, out) == (1, "")
    assert fresh_id in err


def test_trials_density_and_queries(run: Run, fresh_id: str, trials_file: str, tmp_path: Path) -> None:
    run("objects", "create", fresh_id)
    code, out, _ = run("trials", "add", fresh_id, trials_file, "--gripper", "pg70", "--source", "robot")
    assert code == 0
    assert "120 trials stored" in out
    listed = json.loads(run("--json", "trials", "list", fresh_id, "--limit", "1000")[1])
    assert [t["seq"] for t in listed] == sorted(t["seq"] for t in listed)
    assert {(t["gripper"], t["source"]) for t in listed} == {("pg70", "robot")}
    assert len(listed) == 120
    assert "robot" in run("trials", "list", fresh_id, "--limit", "3")[1]
    assert "120" in run("density", fresh_id)[1]
    assert "120" in run("batches", "list", fresh_id)[1]

    box = ("--box-min", "-0.2,-0.1,-0.05", "--box-max", "-0.05,0.1,0.03")
    code, out, _ = run("best-grasp", fresh_id, *box)
    assert code == 0
    assert "relative" in out
    cone = ("--approach", "0,0,-1", "--approach-cone-deg", "30")
    best = json.loads(run("--json", "best-grasp", fresh_id, *cone)[1])
    assert best["status"] == "ok"
    assert best["grasps"][0]["position"] == pytest.approx([0, 0, 0.06], abs=0.006)
    code, out, _ = run("best-grasp", fresh_id, "--count", "2", "--min-separation-m", "0.05")
    assert len(out.strip().splitlines()) == 3
    moved = ("--object-pose", "0.5,0,0,0,0,0,1", *cone)
    world = json.loads(run("--json", "best-grasp", fresh_id, *moved)[1])["grasps"][0]["world"]
    assert np.array(world)[:3, 3] == pytest.approx([0.5, 0, 0.06], abs=0.006)

    code, drawn, _ = run("samples", fresh_id, "--count", "7", "--seed", "1", "--csv")
    assert len(list(csv.DictReader(io.StringIO(drawn)))) == 7
    poses = tmp_path / "poses.csv"
    poses.write_text(drawn)
    found = json.loads(run("--json", "likelihood", fresh_id, str(poses))[1])
    assert len(found["density"]) == 7
    assert found["density"] == pytest.approx(
        [float(row["proposal_density"]) for row in csv.DictReader(io.StringIO(drawn))], rel=1e-3
    )
    ranked = json.loads(run("--json", "best-grasp", fresh_id, "--candidates", str(poses))[1])
    assert ranked["grasps"][0]["candidate"] == int(np.argmax(found["density"]))
    assert ranked["ranking"]["objective"] == "density"
    _, proposed, _ = run("proposals", fresh_id, "--count", "7", "--seed", "1", "--csv")
    assert proposed == drawn
    code, out, _ = run("likelihood", fresh_id, "--pose", "0,0,0.06,1,0,0,0")
    assert code == 0
    assert "relative" in out


def test_no_grasp_is_one_message_and_exit_code_1(run: Run, fresh_id: str, trials_file: str) -> None:
    run("objects", "create", fresh_id)
    assert "no successful trial" in run("best-grasp", fresh_id)[2]
    run("trials", "add", fresh_id, trials_file)
    far = ("--box-min", "1,1,1", "--box-max", "2,2,2")
    code, out, err = run("best-grasp", fresh_id, *far)
    assert (code, out) == (1, "")
    assert "nearest" in err
    code, out, _ = run("--json", "best-grasp", fresh_id, *far)
    assert code == 1
    assert json.loads(out)["nearest"]["position"]


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["objects", "show", "no-such-object"], 1, "no-such-object"),
        (["trials", "add", "no-such-object", "nowhere.csv"], 1, "nowhere.csv"),
        (["objects", "create", "../x"], 1, "id"),
        (["add-example", "teapot"], 1, "screwdriver"),
        (["best-grasp", "x", "--approach", "0,0"], 2, "3 finite numbers"),
        (["best-grasp", "x", "--approach", "0,nan,1"], 2, "3 finite numbers"),
        (["best-grasp", "x", "--box-min", "0,0,0"], 2, "--box-max"),
        (["likelihood", "x"], 2, "--pose"),
        (["best-grasp"], 2, "OBJECT"),
        (["best-grap", "x"], 2, "best-grap"),
        (["sweep", "x", "--max-poses", "0"], 2, "max-poses"),
        (["--url", "http://127.0.0.1:9", "objects", "list"], 1, "graspdb-server serve"),
        (["--url", "127.0.0.1", "objects", "list"], 1, "127.0.0.1"),
    ],
)
def test_errors_are_one_message(run: Run, arguments: list[str], code: int, message: str) -> None:
    ended, out, err = run(*arguments)
    assert ended == code
    assert message in err
    assert "Traceback" not in out + err


def test_bad_trials_name_the_trial_and_field(run: Run, fresh_id: str, tmp_path: Path) -> None:
    run("objects", "create", fresh_id)
    file = tmp_path / "trials.json"
    good = {"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1], "outcome": True}
    file.write_text(json.dumps([good, good | {"quaternion_xyzw": [0, 0, 0, 3]}]))
    code, _, err = run("trials", "add", fresh_id, str(file))
    assert code == 1
    assert "trials.1.quaternion_xyzw" in err
    assert json.loads(run("--json", "objects", "show", fresh_id)[1])["trials"] == 0


def test_grippers(run: Run, fresh_id: str, tmp_path: Path) -> None:
    assert "pg70" in run("grippers", "list")[1]
    profile = json.loads(run("--json", "grippers", "show", "pg70")[1])["profile"]
    file = tmp_path / "gripper.json"
    file.write_text(json.dumps({k: v for k, v in profile.items() if v is not None} | {"force_n": 5}))
    assert run("grippers", "create", fresh_id, str(file), "--name", "Weak")[0] == 0
    assert "Weak" in run("grippers", "show", fresh_id)[1]


@pytest.mark.parametrize(
    ("command", "keywords"),
    [
        ("density", Selection),
        ("best-grasp", Constraints),
        ("sweep", SweepOptions),
        ("trials add", Upload),
        ("trials list", TrialFilters),
        ("objects create", ObjectProperties),
        ("kernels fit", KernelOptions),
    ],
)
def test_commands_take_the_keywords_of_the_sdk(
    help_of: Callable[..., str], command: str, keywords: type
) -> None:
    shown = help_of("graspdb", *command.split())
    options = {
        name: option
        for name, hint in get_type_hints(keywords, include_extras=True).items()
        for option in getattr(hint, "__metadata__", ())
    }
    assert options
    for name, option in options.items():
        ends = [option.lower, option.upper] if isinstance(option, Corners) else [name]
        for flag in option.flag.split("/") if option.flag else [f"--{end.replace('_', '-')}" for end in ends]:
            assert flag in shown, flag
        assert option.help.split()[0] in shown


@pytest.mark.usefixtures("worker")
def test_sweep_and_its_outcomes(run: Run, tmp_path: Path) -> None:
    assert run("add-example", "screwdriver")[0] == 0
    try:
        code, out, err = run("sweep", "screwdriver", "--max-poses", "500", "--wait", "--timeout", "120")
        assert code == 0, err
        assert "500 of 500" in out
        (listed,) = json.loads(run("--json", "sweeps", "list", "--object", "screwdriver")[1])
        assert listed["state"] == "done"
        rows = list(csv.DictReader(io.StringIO(run("sweeps", "outcomes", listed["id"])[1])))
        assert len(rows) == 500
        assert len({row["pose_index"] for row in rows}) == 500
        assert sum(listed["outcomes"].values()) == 500
        assert run("workers")[0] == 0
        poses = tmp_path / "poses.csv"
        poses.write_text("x,y,z,qx,qy,qz,qw\n0,0,0.5,1,0,0,0\n")
        made = run("--json", "sweep", "screwdriver", "--poses", str(poses), "--purpose", "check", "--wait")
        assert json.loads(made[1])["outcomes"] == {"missed": 1}
    finally:
        run("objects", "delete", "screwdriver", "-y")


def test_it_runs_as_a_program_and_in_a_pipe(service_url: str) -> None:
    command = [sys.executable, "-m", "graspdb", "--url", service_url, "--json", "info"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["url"] == service_url
    wrong = subprocess.run(
        [str(Path(sys.executable).with_name("graspdb")), "--url", service_url, "objects", "show", "nothing"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert wrong.returncode == 1
    assert wrong.stdout == ""
    assert wrong.stderr.startswith("Error: ")
