"""The ``graspdb`` command against the real service."""

from __future__ import annotations

import csv
import io
import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
import trimesh
import typer
from typer.testing import CliRunner

from graspdb.cli import TABLE, Entry, app
from graspdb.cli.common import show_table
from graspdb.options import Corners
from graspdb.resources.kernels import KernelOptions
from graspdb.resources.objects import ObjectProperties
from graspdb.resources.selection import Constraints, Selection
from graspdb.resources.sweeps import SweepOptions
from graspdb.resources.trials import TrialFilters, Upload

Run = Callable[..., tuple[int, str, str]]


def test_the_help_of_all_says_of_each_what_it_says_itself(run: Run) -> None:
    group: Any = typer.main.get_command(app)
    assert list(group.commands) == list(TABLE)
    for name, command in group.commands.items():
        assert TABLE[name].help == command.get_short_help_str(1_000), name
    _, out, _ = run("--help")
    assert " ".join(TABLE["import"].help.split()) in " ".join(out.split())


def test_a_command_imports_no_other() -> None:
    program = "import sys; sys.argv = ['graspdb', '--help']; import atexit; from graspdb.cli import main\n"
    program += (
        "atexit.register(lambda: print([m for m in ('numpy', 'pydantic', 'httpx') if m in sys.modules]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", f"{program}\nmain()"], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"


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


def test_an_interruption_in_the_midst_of_an_import_is_not_swallowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    guarded = """
import os, signal
try:
    os.kill(os.getpid(), signal.SIGINT)
    os.getpid()
except BaseException:
    pass

def command() -> None:
    print("went on")
"""
    (tmp_path / "guarded_import.py").write_text(guarded)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(TABLE, "guarded", Entry("", "guarded_import:command"))
    # What was started in the background has it ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        result = CliRunner().invoke(app, ["guarded"])
    finally:
        signal.signal(signal.SIGINT, before)
    assert result.exit_code == 130
    assert "went on" not in result.output
    # Once is enough: the command itself can be run.
    assert "went on" in CliRunner().invoke(app, ["guarded"]).output


def test_objects_from_creation_to_deletion(run: Run, fresh_id: str, tmp_path: Path) -> None:
    mesh = tmp_path / "box.stl"
    trimesh.creation.box((40, 60, 100)).export(mesh)
    code, out, _ = run("objects", "create", fresh_id, "--mesh", str(mesh), "--unit", "mm", "--mass-kg", "0.2")
    assert code == 0
    assert "40.0 x 60.0 x 100.0 mm" in out
    assert fresh_id in run("objects", "list")[1]
    code, out, _ = run("--json", "objects", "show", fresh_id)
    assert json.loads(out)["mass_kg"] == 0.2
    assert run("objects", "change", fresh_id, "--mass-kg", "0.3")[0] == 0
    changed = json.loads(run("--json", "objects", "show", fresh_id)[1])
    assert (changed["mass_kg"], changed["mesh"]["unit"]) == (0.3, "mm")
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


@pytest.fixture
def tried(run: Run, fresh_id: str, tmp_path: Path, clusters: Callable[..., np.ndarray]) -> str:
    """An object of whose trials about two poses every third failed."""
    poses = clusters([([0, 0, 0.06], [1, 0, 0, 0]), ([-0.08, 0, 0], [0, 0.5**0.5, 0, 0.5**0.5])], 60)
    file = tmp_path / "tried.csv"
    held = ["success" if row % 3 else "slipped" for row in range(len(poses))]
    rows = [",".join((*map(repr, pose), outcome)) for pose, outcome in zip(poses.tolist(), held, strict=True)]
    file.write_text("\n".join(["x,y,z,qx,qy,qz,qw,outcome", *rows]) + "\n")
    run("objects", "create", fresh_id)
    assert run("trials", "add", fresh_id, str(file), "--gripper", "panda", "--source", "robot")[0] == 0
    return fresh_id


def test_best_grasps_show_what_they_are_ranked_by(run: Run, tried: str) -> None:
    ranked = ("--objective", "success_probability", "--count", "2", "--min-separation-m", "0.05")
    code, out, err = run("best-grasp", tried, *ranked)
    assert code == 0, err
    header, *rows = out.strip().splitlines()
    assert "success probability" in header
    assert "score" in header
    assert "lower end of the success probability's" in err
    found = json.loads(run("--json", "best-grasp", tried, *ranked)[1])["grasps"]
    assert len(rows) == len(found) == 2
    for row, grasp in zip(rows, found, strict=True):
        ends = f"({grasp['interval']['low']:.2f} to {grasp['interval']['high']:.2f})"
        trials = f"{grasp['effective_trials']:.1f} trials"
        assert f"{grasp['success_probability']:.2f} {ends}, {trials}" in row
        assert f"{grasp['score']:.4g}" in row
    single = run("best-grasp", tried, *ranked[:2])[1]
    (told,) = re.findall(r"interval: ([0-9.]+)", single)
    # Searches for one grasp and for two end where they end: each within half a percent of the best.
    assert float(told) == pytest.approx(found[0]["score"], rel=0.005)


def test_a_best_grasp_is_drawn(run: Run, fresh_id: str, tmp_path: Path, trials_file: str) -> None:
    mesh, picture = tmp_path / "box.stl", tmp_path / "best.png"
    trimesh.creation.box((0.03, 0.03, 0.1)).export(mesh)
    assert run("objects", "create", fresh_id, "--mesh", str(mesh))[0] == 0
    assert run("trials", "add", fresh_id, trials_file, "--gripper", "panda")[0] == 0
    code, _, err = run("best-grasp", fresh_id, "--picture", str(picture))
    assert code == 0, err
    assert str(picture) in err
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_best_grasps_have_world_poses_in_the_frame_asked_for(run: Run, tried: str) -> None:
    """The object stands half a metre away and turned by a quarter about z, which takes x to y."""
    moved = ("--object-pose", "0.5,0,0.1,0,0,0.70710678,0.70710678")
    turned = ("--count", "2", "--min-separation-m", "0.05", *moved)
    single = run("best-grasp", tried, *moved)[1]
    for name in ("position", "quaternion", "approach"):
        assert f"{name} in the world" in single
    header, *rows = run("best-grasp", tried, *turned)[1].strip().splitlines()
    for name in ("position [m]", "quaternion xyzw", "approach"):
        assert f"world {name}" in header
    assert "world" not in run("best-grasp", tried, *turned, "--frame", "object")[1]

    # What poses are of stands with them.
    _, header, told = run("best-grasp", tried, *turned, "--gripper", "panda", "--frame", "flange")
    assert "flange world position [m]" in header
    assert "Poses are of the flange in the world frame." in told
    single = run("best-grasp", tried, *moved, "--gripper", "panda", "--frame", "flange")[1]
    assert "flange, in the object frame" in single
    assert "tool, in the object frame" in run("best-grasp", tried)[1]
    pose = ("--pose", "0,0,0.1,1,0,0,0", "--gripper", "panda", "--frame", "flange")
    _, header, told = run("likelihood", tried, *pose)
    assert "flange position [m]" in header
    assert "Poses are of the flange in the object frame." in told

    table = list(csv.DictReader(io.StringIO(run("best-grasp", tried, *turned, "--csv")[1])))
    assert len(table) == len(rows) == 2
    for row in table:
        x, y, z = (float(row[name]) for name in "xyz")
        world = [float(row[f"world_{name}"]) for name in "xyz"]
        assert world == pytest.approx([0.5 - y, x, 0.1 + z])
        turn, pose = ([float(row[f"{of}q{name}"]) for name in "xyzw"] for of in ("world_", ""))
        assert abs(np.dot(turn, _product([0, 0, 0.5**0.5, 0.5**0.5], pose))) == pytest.approx(1.0)
    assert {"score", "density", "success_probability", "low", "high", "effective_trials"} <= set(table[0])


def _product(a: list[float], b: list[float]) -> list[float]:
    """The quaternion (x, y, z, w) of rotation ``b`` and then ``a``."""
    vector = a[3] * np.array(b[:3]) + b[3] * np.array(a[:3]) + np.cross(a[:3], b[:3])
    return [*vector.tolist(), a[3] * b[3] - float(np.dot(a[:3], b[:3]))]


def test_likelihood_as_csv(run: Run, tried: str, tmp_path: Path) -> None:
    drawn = tmp_path / "drawn.csv"
    drawn.write_text(run("samples", tried, "--count", "30", "--seed", "1", "--csv")[1])
    table = list(csv.DictReader(io.StringIO(run("likelihood", tried, str(drawn), "--csv")[1])))
    given = list(csv.DictReader(io.StringIO(drawn.read_text())))
    assert len(table) == len(given) == 30
    for row, pose in zip(table, given, strict=True):
        assert float(row["qw"]) == pytest.approx(float(pose["qw"]))
        assert float(row["density"]) == pytest.approx(float(pose["proposal_density"]), rel=1e-3)
        assert float(row["low"] or 0) <= float(row["success_probability"] or 0.5) <= float(row["high"] or 1)


def test_doubtful_trials_are_told_and_mended(run: Run, fresh_id: str, tmp_path: Path) -> None:
    mesh, file = tmp_path / "box.stl", tmp_path / "mm.json"
    trimesh.creation.box((40, 60, 100)).export(mesh)
    run("objects", "create", fresh_id, "--mesh", str(mesh), "--unit", "mm")
    across = [0.0, 0.5**0.5, 0.5**0.5, 0.0]
    trials = [
        {"position": [x, 0, 45], "quaternion_xyzw": across, "outcome": True}
        for x in np.linspace(-5, 5, 12).tolist()
    ]
    file.write_text(json.dumps({"gripper": "panda", "trials": trials}))
    add = ("trials", "add", fresh_id, str(file), "--quaternion-order", "wxyz")
    code, _, err = run(*add)
    assert code == 1
    assert "--unit mm" in err
    code, out, _ = run(*add, "--unit", "mm")
    assert code == 0
    assert "Doubtful" not in out
    code, out, err = run(*add, "--unit", "mm")
    assert code == 0
    assert "Doubtful (posted-before): 12 of 12 trials" in out
    assert err == ""
    batch = json.loads(run("--json", "batches", "list", fresh_id)[1])[-1]
    assert "posted-before" in run("batches", "list", fresh_id)[1]
    assert "delete one of the batches" in run("batches", "show", fresh_id, batch["batch"])[1]
    assert "Doubtful (posted-before)" in run("density", fresh_id)[1]
    assert run(*add, "--accept-implausible")[0] == 0
    assert run(*add, "--unit", "feet")[0] == 2


def test_a_trial_is_withdrawn_and_corrected(run: Run, fresh_id: str, trials_file: str) -> None:
    run("objects", "create", fresh_id)
    run("trials", "add", fresh_id, trials_file)
    assert "Trial 7 is withdrawn" in run("trials", "withdraw", fresh_id, "7", "--reason", "wrong object")[1]
    assert "success (withdrawn)" in run("trials", "list", fresh_id)[1]
    assert json.loads(run("--json", "trials", "list", fresh_id, "--withdrawn")[1])[0]["seq"] == 7
    assert json.loads(run("--json", "objects", "show", fresh_id)[1])["trials"] == 119
    _, out, _ = run("trials", "correct", fresh_id, "7", "--reinstate", "--outcome", "slipped")
    assert "withdrawn False, until" in out
    assert "(wrong object)" in out
    assert "slipped" in out
    assert json.loads(run("--json", "trials", "show", fresh_id, "7")[1])["history"][1]["before"] == {
        "outcome": "success",
        "withdrawn": True,
    }
    assert run("trials", "correct", fresh_id, "7")[0] == 2
    assert run("trials", "withdraw", fresh_id, "777")[0] == 1


def test_no_probability_is_shown_without_its_interval_and_trials(
    run: Run, fresh_id: str, tmp_path: Path, clusters: Callable[..., np.ndarray]
) -> None:
    poses = clusters([([0, 0, 0.06], [1, 0, 0, 0])], 80)
    path = tmp_path / "tried.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["x", "y", "z", "qx", "qy", "qz", "qw", "outcome"])
        rows = enumerate(poses.tolist())
        writer.writerows([*row, "success" if place % 3 else "slipped"] for place, row in rows)
    run("objects", "create", fresh_id)
    run("trials", "add", fresh_id, str(path))
    told = re.compile(r"\d\.\d\d \(\d\.\d\d to \d\.\d\d\), \d+\.\d trials")
    for count in ("1", "2"):
        out = run("best-grasp", fresh_id, "--count", count, "--min-separation-m", "0.005")[1]
        assert "success probability" in out
        assert len(told.findall(out)) == int(count)
    out = run("likelihood", fresh_id, "--pose", "0,0,0.06,1,0,0,0")[1]
    assert told.search(out)
    # From the side nothing was tried: no probability, and why.
    side = ("--approach", "1,0,0", "--approach-cone-deg", "20")
    out = run("best-grasp", fresh_id, *side)[1]
    assert "unknown: the nearest attempt is" in " ".join(out.split())
    assert not told.search(out)
    code, out, err = run("likelihood", fresh_id, "--pose", "0,0,0.06,0,0.7071068,0,0.7071068")
    assert code == 0
    assert "unknown" in out
    assert "from the nearest attempt" in " ".join(err.split())
    assert run("best-grasp", fresh_id, *side, "--min-success-probability", "0.1")[0] == 1
    assert "nearest attempt" in run("samples", fresh_id, "--seed", "1")[1]


def test_no_grasp_is_one_message_and_exit_code_1(run: Run, fresh_id: str, trials_file: str) -> None:
    run("objects", "create", fresh_id)
    assert "no successful trial" in run("best-grasp", fresh_id)[2]
    run("trials", "add", fresh_id, trials_file)
    far = ("--box-min", "1,1,1", "--box-max", "2,2,2")
    code, out, err = run("best-grasp", fresh_id, *far)
    assert (code, out) == (1, "")
    assert "nearest" in err
    assert "--box-min excludes all that was tried; --box-min " in err
    code, out, _ = run("--json", "best-grasp", fresh_id, *far)
    assert code == 1
    assert json.loads(out)["nearest"]["position"]
    assert json.loads(out)["conflict"] == ["box_min"]


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


def test_an_object_is_copied(run: Run, fresh_id: str) -> None:
    assert run("objects", "create", fresh_id)[0] == 0
    assert f"{fresh_id}, revision 0" in run("objects", "copy", fresh_id, f"{fresh_id}-2", "--trials")[1]
    assert "already" in run("objects", "copy", fresh_id, f"{fresh_id}-2")[2]


def test_grippers(run: Run, fresh_id: str, tmp_path: Path) -> None:
    assert "pg70" in run("grippers", "list")[1]
    profile = json.loads(run("--json", "grippers", "show", "pg70")[1])["profile"]
    file = tmp_path / "gripper.json"
    file.write_text(json.dumps({k: v for k, v in profile.items() if v is not None} | {"force_n": 5}))
    assert run("grippers", "create", fresh_id, str(file), "--name", "Weak")[0] == 0
    assert "Weak" in run("grippers", "show", fresh_id)[1]
    file.write_text(json.dumps(profile | {"force_n": 11}))
    assert f"{fresh_id}@2 now: force_n changed" in run("grippers", "update", fresh_id, str(file))[1]
    assert json.loads(run("grippers", "show", f"{fresh_id}@1")[1])["force_n"] != 11
    assert json.loads(run("grippers", "show", fresh_id)[1])["force_n"] == 11
    assert f"{fresh_id}@2" in run("grippers", "versions", fresh_id)[1]
    assert run("grippers", "delete", fresh_id)[0] == 0
    assert "no gripper" in run("grippers", "show", fresh_id)[2]


def test_a_wrong_profile_names_its_file(run: Run, fresh_id: str, tmp_path: Path) -> None:
    file = tmp_path / "gripper.json"
    file.write_text("{")
    assert f"{file} is no JSON" in run("grippers", "create", fresh_id, str(file))[2]
    back = {"position": [0, 0, 0.14], "quaternion_xyzw": [1, 0, 0, 0]}
    shape = {
        "max_opening_m": 0.08,
        "finger": {"width_m": 0.02, "thickness_m": 0.01, "length_m": 0.05},
        "palm_size_m": [0.06, 0.2, 0.06],
    }
    file.write_text(json.dumps({**shape, "base_to_tool": back}))
    told = run("grippers", "create", fresh_id, str(file))[2]
    assert "  base_to_tool puts the gripper's base 140 mm ahead" in told
    assert str(file) in told


def test_who_can_not_be_asked_is_told_of_yes(run: Run, tried: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (batch,) = json.loads(run("--json", "batches", "list", tried)[1])
    for answer, code, said in (("", 1, "--yes"), ("n\n", 1, "Aborted"), ("y\n", 0, "")):
        monkeypatch.setattr(sys, "stdin", io.StringIO(answer))
        ended, _, told = run("batches", "delete", tried, batch["batch"])
        assert ended == code
        assert said in told


def test_no_word_of_a_table_is_broken(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    word = "0f9b3a52-6e0d-4e86-9c1b-2d1f4c0a7e11"
    show_table([word, word], {str(n): lambda item: f"{item} and {item}" for n in range(4)}, empty="")
    for line in capsys.readouterr().out.splitlines()[1:]:
        assert set(line.split()) <= {word, "and"}


@pytest.mark.parametrize("as_json", [(), ("--json",)])
def test_a_gripper_as_shown_can_be_created_again(
    run: Run, fresh_id: str, tmp_path: Path, as_json: tuple[str, ...]
) -> None:
    file = tmp_path / "gripper.json"
    file.write_text(run(*as_json, "grippers", "show", "panda")[1])
    assert run("grippers", "create", fresh_id, str(file))[0] == 0
    ours, theirs = (json.loads(run("--json", "grippers", "show", name)[1]) for name in (fresh_id, "panda"))
    assert (ours["profile"], ours["name"]) == (theirs["profile"], theirs["name"])


def test_a_sweep_says_what_it_waits_for(run: Run, fresh_id: str, tmp_path: Path) -> None:
    """A ring is not convex: a worker has to make its parts first."""
    trimesh.creation.annulus(0.02, 0.03, 0.02).export(tmp_path / "ring.stl")
    run("objects", "create", fresh_id, "--mesh", str(tmp_path / "ring.stl"), "--mass-kg", "0.1")
    code, out, err = run("sweep", fresh_id, "--max-poses", "100")
    assert code == 0, err
    (waiting,) = [line for line in out.splitlines() if line.startswith("waits for")]
    assert "convex parts: " in waiting
    (sweep,) = json.loads(run("--json", "sweeps", "list", "--object", fresh_id)[1])
    try:
        assert "convex parts: " in run("sweeps", "show", sweep["id"])[1]
        assert "convex parts: " in run("sweeps", "list", "--object", fresh_id)[1]
        ended, _, err = run("sweeps", "wait", sweep["id"], "--timeout", "0.1")
        assert ended == 1
        assert f"graspdb sweeps cancel {sweep['id']}" in err
    finally:
        assert "waits for" not in run("sweeps", "cancel", sweep["id"])[1]


def test_parts_are_set_after_the_mesh(run: Run, fresh_id: str, tmp_path: Path) -> None:
    run("objects", "create", fresh_id)
    parts = trimesh.Scene([trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.box((0.2, 0.05, 0.05))])
    parts.export(tmp_path / "parts.glb")
    code, out, err = run("objects", "set-convex-parts", fresh_id, str(tmp_path / "parts.glb"))
    assert code == 0, err
    assert json.loads(run("--json", "objects", "show", fresh_id)[1])["convex_parts"]["parts"] == 2
    assert "convex parts" in out
    # Against a mesh that they do not follow they are refused, in words of the command line.
    tube = trimesh.creation.annulus(r_min=0.03, r_max=0.035, height=0.1)
    tube.export(tmp_path / "tube.stl")
    run("objects", "set-mesh", fresh_id, str(tmp_path / "tube.stl"))
    trimesh.Scene([tube.convex_hull]).export(tmp_path / "hull.glb")
    code, _, err = run("objects", "set-convex-parts", fresh_id, str(tmp_path / "hull.glb"))
    assert code != 0
    assert "--accept-deviation" in err
    assert "accept_deviation" not in err
    code, out, err = run(
        "objects", "set-convex-parts", fresh_id, str(tmp_path / "hull.glb"), "--accept-deviation"
    )
    assert code == 0, err
    assert "mm off the mesh" in out


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
