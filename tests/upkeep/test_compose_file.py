"""compose.yaml by itself; no test runs it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import tomllib
import yaml

from graspdb_service.settings import Settings

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "compose.yaml").read_text("utf-8")
SERVICES: dict[str, Any] = yaml.safe_load(TEXT)["services"]
STRANGE = "it's %41 p@ss:w/ö?r#d\\&$HOME ${X:-y} $$ `id` {}\"; -- "


def one_shot(folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """The program of ``secrets``, with another folder than the volume's."""
    (program,) = SERVICES["secrets"]["command"]
    told = {"GRASPDB_DB_PASSWORD": "", "ADDRESS": "127.0.0.1", "AUTH": "", **environment}
    return subprocess.run(
        [sys.executable, "-c", program.replace("/run/graspdb", str(folder))],
        env={**os.environ, **told},
        capture_output=True,
        text=True,
        check=False,
    )


def test_passwords_are_made_once_kept_and_changed_to_what_is_given(tmp_path: Path) -> None:
    assert one_shot(tmp_path).returncode == 0
    made = {file.name: file.read_text("utf-8") for file in tmp_path.iterdir()}
    assert made.keys() == {"password", "grafana"}
    assert all(len(word) >= 32 for word in made.values())
    assert one_shot(tmp_path).returncode == 0
    assert {file.name: file.read_text("utf-8") for file in tmp_path.iterdir()} == made
    for _ in range(2):  # given once, it stays
        assert one_shot(tmp_path, GRASPDB_DB_PASSWORD=STRANGE).returncode == 0
        assert (tmp_path / "password").read_bytes().decode() == STRANGE
    assert one_shot(tmp_path).returncode == 0
    assert (tmp_path / "password").read_bytes().decode() == STRANGE
    assert (tmp_path / "grafana").read_text("utf-8") == made["grafana"]


@pytest.mark.parametrize(
    ("address", "auth", "starts"),
    [("0.0.0.0", "", False), ("192.168.1.5", "", False), ("0.0.0.0", "keys", True), ("0.0.0.0", "off", True)],
)
def test_nobody_is_let_in_by_oversight(tmp_path: Path, address: str, auth: str, starts: bool) -> None:
    done = one_shot(tmp_path, ADDRESS=address, AUTH=auth)
    assert (done.returncode == 0) == starts
    assert starts or "GRASPDB_AUTH=keys" in done.stderr


def test_every_container_is_contained_and_bounded() -> None:
    for name, service in SERVICES.items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"], name
        assert "no-new-privileges:true" in service["security_opt"], name
        assert service["restart"] == "no" or "mem_limit" in service, name
        assert "build" not in service or service["pull_policy"] == "build", name


def test_files_variables_and_settings_are_there() -> None:
    guide = (ROOT / "docs/guide/compose.md").read_text("utf-8")
    for name in set(re.findall(r"\$\{(GRASPDB_\w+)", TEXT)) - {"GRASPDB_SERVICE_MEMORY"}:
        brief = name.replace("GRASPDB_", "...").replace("...WORKER_MEMORY", "..._WORKER_...")
        assert f"`{name}`" in guide or brief.replace("...DB_MEMORY", "..._DB_...") in guide, name
    known = {f"GRASPDB_{name.upper()}" for name in Settings.model_fields}
    for name, service in SERVICES.items():
        for mounted in service.get("volumes", ()):
            source = mounted.split(":")[0]
            assert not source.startswith(".") or (ROOT / source).exists(), (name, source)
        if service["image"] == "graspdb-service" and name != "secrets":
            told = {key for key in service["environment"] if key.startswith("GRASPDB_")}
            assert told <= known, (name, told - known)


@pytest.mark.parametrize(
    ("image", "packages"),
    [
        ("service", ("matplotlib", "pyarrow")),
        ("simworker", ("distributed",)),
        ("clients", ("viser", "plotly")),
    ],
)
def test_images_hold_what_their_users_expect(image: str, packages: tuple[str, ...]) -> None:
    pinned = (ROOT / image / "requirements.txt").read_text()
    assert all(re.search(rf"^{package}==", pinned, re.MULTILINE) for package in packages)


def test_images_are_given_every_file_that_the_package_takes_along() -> None:
    """What .dockerignore leaves out can't be installed."""
    ignored = (ROOT / ".dockerignore").read_text().split()
    taken = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["hatch"]["build"]["targets"]
    for path in taken["wheel"]["force-include"]:
        folder = path.split("/")[0]
        for image in ("service", "simworker", "clients"):
            assert f"COPY {folder} {folder}" in (ROOT / image / "Dockerfile").read_text(), path
        assert folder not in ignored, path
        assert f"{folder}/*" not in ignored or f"!{path}" in ignored, path
