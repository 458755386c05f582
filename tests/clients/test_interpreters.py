"""The interpreters and NumPys that users have, those found on this machine: what is not there is named."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from graspdb.processes import ChildProcess

ROOT = Path(__file__).resolve().parents[2]
SCENARIO = ROOT / "tests/support/sdk_scenario.py"

pytestmark = [pytest.mark.long, pytest.mark.timeout(1_800)]


def _interpreter(version: str) -> str | None:
    """A Python of this version: of the tests themselves, on the path, or where pyenv keeps them."""
    own = f"{sys.version_info.major}.{sys.version_info.minor}"
    places = [sys.executable] if version == own else []
    places += [found for found in [shutil.which(f"python{version}")] if found]
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    places += sorted(map(str, pyenv.glob(f"{version}.*/bin/python")))
    for place in places:
        asked = [place, "-c", "import sys, venv, ensurepip; print('%d.%d' % sys.version_info[:2])"]
        told = subprocess.run(asked, capture_output=True, text=True, check=False)
        if told.returncode == 0 and told.stdout.strip() == version:
            return place
    return None


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (built,) = folder.glob("*.whl")
    return built


def _installed(version: str, folder: Path, *what: str) -> Path:
    """The ``bin`` of a fresh environment with this; skips, saying why, where interpreter or wheels are not
    there.
    """
    python = _interpreter(version)
    if python is None:
        pytest.skip(f"there is no Python {version} on this machine: this corner was not tried")
    subprocess.run([python, "-m", "venv", str(folder)], check=True, capture_output=True)
    pip = [str(folder / "bin/python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    # Wheels alone: what would have to be built says nothing of users, who have wheels.
    done = subprocess.run([*pip, "--only-binary=:all:", *what], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        told = done.stderr.strip().splitlines()[-1:]
        if re.search("connection|resolve host|timed out|No matching distribution.*none", done.stderr, re.I):
            pytest.skip(f"wheels for Python {version} can't be had here: this corner was not tried ({told})")
        pytest.fail(f"Python {version}: pip install {' '.join(what)}: {done.stderr}")
    return folder / "bin"


def _run(bin: Path, url: str) -> str:
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(
        [str(bin / "python"), str(SCENARIO), url, f"corner-{uuid.uuid4().hex[:8]}"],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
        cwd=bin,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("python", "numpy"),
    [
        pytest.param("3.10", "1.21.*", id="ROS-2-Humble"),
        pytest.param("3.10", "", id="3.10-newest"),
        pytest.param("3.11", "1.26.*", id="Isaac-Sim-5"),
        pytest.param("3.12", "1.26.*", id="ROS-2-Jazzy"),
        pytest.param("3.13", "", id="3.13-newest"),
    ],
)
def test_the_bare_sdk_runs_where_robots_have_it(
    service_url: str, wheel: Path, tmp_path: Path, python: str, numpy: str
) -> None:
    pinned = f"numpy=={numpy}" if numpy else "numpy"
    told = _run(_installed(python, tmp_path / "venv", str(wheel), pinned), service_url)
    assert f"Python {python}." in told
    assert not numpy or f"NumPy {numpy.rstrip('*')}" in told


@pytest.fixture
def served(request: pytest.FixtureRequest, wheel: Path, tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """The service, installed and run by a Python of the version asked for: its ``bin`` and its address."""
    bin = _installed(request.param, tmp_path / "venv", f"{wheel}[service,arrow,plot]")
    log = tmp_path / "log"
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith(("GRASPDB_", "PYTHON"))
    }
    port = 20_000 + uuid.uuid4().int % 20_000
    with log.open("wb") as output:
        process = ChildProcess(
            [str(bin / "graspdb-server"), "serve", "--port", str(port)],
            env={**environment, "GRASPDB_DATABASE_URL": f"sqlite:///{tmp_path / 'graspdb.sqlite'}"},
            stdout=output,
            stderr=subprocess.STDOUT,
            cwd=tmp_path,
        )
    url = f"http://127.0.0.1:{port}"
    try:
        deadline = time.monotonic() + 300
        while True:
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < deadline, log.read_text()
            try:
                if httpx.get(f"{url}/readyz").is_success:
                    break
            except httpx.TransportError:
                pass
            time.sleep(0.1)
        yield bin, url
    finally:
        process.terminate()
        process.wait(60)


@pytest.mark.parametrize("served", ["3.10", "3.12", "3.13"], indirect=True)
def test_the_service_runs_on_every_python(served: tuple[Path, str]) -> None:
    bin, url = served
    _run(bin, url)
    box = b"".join(b"v %g %g %g\n" % (x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1))
    for a, b, c, d in ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)):
        box += b"f %d %d %d %d\n" % (a, b, c, d)
    with httpx.Client(base_url=url, timeout=120) as http:
        assert http.post("/objects", json={"id": "box"}).status_code == 201
        mesh = http.put(
            "/objects/box/mesh?unit=cm&scale=2", content=box, headers={"Content-Type": "model/obj"}
        )
        assert mesh.json()["volume_m3"] == pytest.approx(0.04**3)
        arrow = http.get("/objects/box/trials", headers={"Accept": "application/vnd.apache.arrow.stream"})
        assert arrow.status_code == 200
        answer = http.get("/objects/box/best-grasp", params={"gripper": "panda"})
        assert answer.json()["grasps"][0]["prior"], answer.text


@pytest.mark.parametrize("python", ["3.10", "3.12", "3.13"])
def test_the_worker_simulates_in_mujoco_on_every_python(wheel: Path, tmp_path: Path, python: str) -> None:
    bin = _installed(python, tmp_path / "venv", f"{wheel}[sim,mujoco]")
    rim = ["--position=0,0.028,0.035", "--quaternion=1,0,0,0", "--url="]
    done = subprocess.run(
        [str(bin / "graspdb-simworker"), "show", "mug", *rim, "--engine=mujoco", "--out=motion.json"],
        capture_output=True,
        text=True,
        env={key: value for key, value in os.environ.items() if not key.startswith("PYTHON")},
        check=False,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("success: ")
