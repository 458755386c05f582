"""The child process that reads untrusted meshes."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import trimesh

from graspdb.examples import example
from graspdb_geometry import meshes
from graspdb_geometry.meshes import MeshError
from graspdb_service.usecases.geometry.mesh_child import inspect_in_child
from graspdb_service.usecases.geometry.mesh_form import MeshForm

TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def test_the_child_gives_the_same_answer() -> None:
    data = example("mug").stl()
    here, there = meshes.inspect(data, "model/stl"), inspect_in_child(data, MeshForm("model/stl"))
    assert here.properties == there.properties
    np.testing.assert_array_equal(here.mesh.vertices, there.mesh.vertices)
    np.testing.assert_array_equal(here.mesh.faces, there.mesh.faces)


def test_the_child_reports_refusals() -> None:
    with pytest.raises(MeshError, match="finite") as caught:
        inspect_in_child(b"v nan 0 0\n" + TRIANGLE + b"f 1 2 3\n", MeshForm("model/obj"))
    assert caught.value.field == "mesh"
    with pytest.raises(MeshError) as caught:
        inspect_in_child(b"x", MeshForm("model/3mf"))
    assert caught.value.field == "content_type"


def test_the_childs_memory_is_bounded() -> None:
    lump = trimesh.creation.icosphere(subdivisions=6, radius=0.1)
    with pytest.raises(MeshError, match="memory"):
        inspect_in_child(lump.export(file_type="stl"), MeshForm("model/stl"), memory_bytes=150 * 2**20)


def test_the_childs_time_is_bounded() -> None:
    lines = TRIANGLE + b"f 1 2 3\n" * 900_000
    with pytest.raises(MeshError, match=r"took more than 0\.4 s"):
        inspect_in_child(lines, MeshForm("model/obj"), seconds=0.1)


def test_the_child_ends_with_a_killed_service(
    eventually: Callable[..., Any], descendants: Callable[[], list[str]]
) -> None:
    program = (
        "from graspdb_service.usecases.geometry.mesh_child import inspect_in_child\n"
        "from graspdb_service.usecases.geometry.mesh_form import MeshForm\n"
        f"content = {TRIANGLE!r} + b'f 1 2 3\\n' * 4_000_000\n"
        "inspect_in_child(content, MeshForm('model/obj'), max_triangles=10**9)"
    )
    service = subprocess.Popen([sys.executable, "-c", program])
    try:
        eventually(lambda: any("mesh_child" in line and " -m " in line for line in descendants()))
    finally:
        service.kill()
        service.wait()
    eventually(lambda: not descendants(), 10)
