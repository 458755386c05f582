"""The README's commands, as a newcomer copies them, against the real service and a real worker."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import trimesh

from graspdb import Client

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
URL = "http://127.0.0.1:8000"


def _blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def test_curl_alone_registers_an_object_posts_trials_and_gets_a_best_grasp(service_url: str) -> None:
    commands = [block for block in _blocks("bash") if block.startswith("curl")]
    assert len(commands) == 3
    answers = []
    for command in commands:
        assert URL in command
        done = subprocess.run(
            ["sh", "-ec", command.replace(URL, service_url)], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        answers.append(json.loads(done.stdout))
    created, receipt, best = answers
    assert created["id"] == "bottle"
    assert receipt["inserted"] == 5
    assert best["status"] == "ok"
    (grasp,) = best["grasps"]
    # The two coinciding successes outweigh the tilted third; the slipped one and the side grasp are out.
    assert grasp["position"] == pytest.approx([0.002, 0.001, 0.09], abs=0.003)
    assert abs(grasp["quaternion_xyzw"][0]) > 0.99
    again = subprocess.run(
        ["sh", "-ec", commands[1].replace(URL, service_url)], capture_output=True, text=True, check=True
    )
    assert json.loads(again.stdout) == receipt


@pytest.mark.usefixtures("worker")
def test_the_python_examples_run(service_url: str, tmp_path: Path) -> None:
    programs = _blocks("python")
    assert len(programs) == 2
    _without(service_url, "can", "mug")
    outputs = []
    for program in programs:
        assert URL in program
        done = subprocess.run(
            [sys.executable, "-c", program.replace(URL, service_url)],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        outputs.append(done.stdout)
    assert outputs[0].startswith("Grasp(")
    assert "'success'" in outputs[1]
    with Client(service_url) as db:
        assert db.objects.get("can").info.trials == 200
        assert db.objects.get("mug").info.trials == 20_000


@pytest.mark.usefixtures("worker")
def test_the_command_lines_run(service_url: str, tmp_path: Path) -> None:
    """Everything that is typed at ``graspdb``, in its order, on an object that is not there before."""
    blocks = [block for block in _blocks("bash") if block.startswith("graspdb ")]
    assert len(blocks) == 2
    (tmp_path / "my-trials.csv").write_text(
        "x,y,z,qx,qy,qz,qw,outcome\n0,0,0.08,1,0,0,0,success\n0.01,0,0.08,1,0,0,0,slipped\n"
    )
    (tmp_path / "bottle.stl").write_bytes(trimesh.creation.cylinder(30, 200).export(file_type="stl"))
    (upload,) = re.findall(r"`(curl -T [^`]+)`", README)
    _without(service_url, "mug", "bottle")
    with Client(service_url) as db:
        db.objects.create("bottle")
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        for typed in (upload, *blocks):
            done = subprocess.run(
                ["sh", "-ec", typed.replace(URL, service_url)],
                cwd=tmp_path,
                env={**os.environ, "PATH": path, "GRASPDB_URL": service_url},
                capture_output=True,
                text=True,
                check=False,
            )
            assert done.returncode == 0, done.stdout + done.stderr
        mug = db.objects.get("mug").info
        assert mug.trials == 2 + 20_000
        assert db.objects.get("bottle").info.mesh is not None
    assert (tmp_path / "convergence.svg").stat().st_size > 1_000


def _without(url: str, *names: str) -> None:
    """What other tests type makes these objects, too."""
    with Client(url) as db:
        for known in db.objects.list():
            if known.id in names:
                known.delete()


def test_the_commands_it_names_exist(help_of: Callable[..., str]) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert {"demo", "test", "install"} <= targets & set(re.findall(r"make ([a-z]+)", README))
    for program, *arguments in re.findall(r"^(graspdb[a-z-]*) ([a-z-]+)(?: ([a-z]+))?", README, re.MULTILINE):
        words = [word for word in arguments if word in {"serve", "run", "add"}] or arguments[:1]
        if arguments[0] == "trials":
            words = arguments
        help_of(program, *words)


def test_links_lead_somewhere() -> None:
    here = ROOT / "README.md"
    links = re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]+))?\)", here.read_text(encoding="utf-8"))
    assert links
    for target, anchor in links:
        if target.startswith("https://"):
            continue
        path = here.parent / target if target else here
        assert path.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            slugs = {
                re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in headings
            }
            assert anchor in slugs, (target, anchor)
