"""The wheel: complete, and light where only the SDK and the command line are wanted."""

from __future__ import annotations

import email
import importlib.metadata
import os
import re
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "graspdb",
    "graspdb_density",
    "graspdb_estimators",
    "graspdb_robots",
    "graspdb_geometry",
    "graspdb_service",
    "graspdb_simworker",
    "graspdb_viewer",
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (built,) = folder.glob("*.whl")
    return built


def test_the_wheel_has_every_package_its_types_and_the_migrations(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == PACKAGES
    assert {f"{package}/py.typed" for package in PACKAGES} <= names
    here = {
        f"graspdb_service/migrations/{path.relative_to(ROOT / 'db/migrations').as_posix()}"
        for path in (ROOT / "db/migrations").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert any(name.endswith("env.py") for name in here)
    assert here <= names
    for package in PACKAGES:
        source = next(ROOT.glob(f"*/{package}"))
        modules = {f"{package}/{path.relative_to(source).as_posix()}" for path in source.rglob("*.py")}
        assert modules <= names


def _install(wheel: Path, distributions: set[str], folder: Path) -> Path:
    """A site-packages with the wheel and these distributions only, the latter linked."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    site = Path(sysconfig.get_path("purelib"))
    for distribution in distributions:
        files = importlib.metadata.distribution(distribution).files or []
        for top in {file.parts[0] for file in files} - {"..", "__pycache__"}:
            (folder / top).symlink_to(site / top)
    return folder


def _run(site: Path, program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a program that sees nothing but this site-packages and the standard library."""
    return subprocess.run(
        # Without `site`, no .pth file brings the checkout back.
        [
            sys.executable,
            "-I",
            "-S",
            "-c",
            f"import sys; sys.path.insert(0, {str(site)!r})\n{program}",
            *arguments,
        ],
        capture_output=True,
        text=True,
        env={key: value for key, value in os.environ.items() if not key.startswith("GRASPDB_")},
        check=False,
    )


def _closure(names: set[str]) -> set[str]:
    """These distributions and all that they require."""
    found: set[str] = set()
    wanted = list(names)
    while wanted:
        requirement = wanted.pop()
        if "extra ==" in requirement:
            continue
        matched = re.match(r"[A-Za-z0-9._-]+", requirement)
        assert matched is not None
        name = re.sub(r"[-_.]+", "-", matched.group()).lower()
        if name in found:
            continue
        try:
            wanted += importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue  # its marker does not fit this interpreter
        found.add(name)
    return found


def _requirements(wheel: Path, extra: str | None = None) -> set[str]:
    """What ``pip install graspdb`` brings, or with the extra."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        required = email.message_from_bytes(archive.read(name)).get_all("Requires-Dist") or []
    mine = {r for r in required if "extra ==" not in r}
    if extra is not None:
        mine |= {r.split(";")[0] for r in required if re.search(f"extra == ['\"]{extra}['\"]", r)}
    return _closure(mine)


BARE = """
import importlib.util
for name in ("fastapi", "sqlalchemy", "numba", "scipy", "trimesh", "pybullet", "uvicorn", "pandas"):
    assert importlib.util.find_spec(name) is None, name
import graspdb, graspdb.cli, graspdb.client, graspdb.demo, graspdb.examples, graspdb.transport, graspdb.wire
assert graspdb.__file__.startswith(sys.path[0]), graspdb.__file__
assert graspdb.examples.example("mug").stl()
try:
    graspdb.Client("http://127.0.0.1:9").add_example("mug")
except ImportError as error:
    assert "graspdb[examples]" in str(error), error
else:
    raise AssertionError("the examples need trimesh")
sys.argv = ["graspdb", "--help"]
graspdb.cli.main()
"""


def test_importing_the_sdk_imports_nothing_heavy() -> None:
    """A robot's program starts as fast as it can: what only some calls need is imported by these."""
    heavy = (
        "scipy",
        "pandas",
        "matplotlib",
        "trimesh",
        "pyarrow",
        "numba",
        "fastapi",
        "sqlalchemy",
        "h5py",
        "yaml",
    )
    program = (
        f"import sys; from graspdb import Client; print([name for name in {heavy} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    needed = ("numpy", "pydantic", "httpx", "rich")
    program = f"import sys; import graspdb; print([name for name in {needed} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_bare_install_is_sdk_and_command_line(wheel: Path, tmp_path: Path) -> None:
    bare = _requirements(wheel)
    assert {"httpx", "numpy", "pydantic", "rich", "typer"} <= bare
    done = _run(_install(wheel, bare, tmp_path), BARE)
    assert done.returncode == 0, done.stderr
    assert "best-grasp" in done.stdout


@pytest.mark.parametrize(
    ("module", "arguments", "extra"),
    [
        ("graspdb_service.cli", ["serve"], "service"),
        ("graspdb_simworker.cli", ["run", "--exit-when-idle"], "sim"),
    ],
)
def test_the_other_commands_explain_what_they_miss(
    wheel: Path, tmp_path: Path, module: str, arguments: list[str], extra: str
) -> None:
    site = _install(wheel, _requirements(wheel), tmp_path)
    done = _run(site, f"import {module} as command\ncommand.main()", *arguments)
    assert done.returncode in {1, 2}
    assert f"pip install 'graspdb[{extra}]'" in done.stderr
    assert "Traceback" not in done.stderr


def test_the_service_runs_from_its_extra_alone(wheel: Path, tmp_path: Path) -> None:
    site = _install(wheel, _requirements(wheel, "service"), tmp_path / "site")
    database = f"sqlite:///{tmp_path / 'scratch.sqlite'}"
    program = "import graspdb_service.cli as command\ncommand.main()"
    done = _run(site, program, "migrate", "--database-url", database)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "scratch.sqlite").exists()
