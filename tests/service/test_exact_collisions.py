"""Questions are tested against the mesh itself, whatever its parts are, which tell what it leaves open."""

from __future__ import annotations

from typing import Any

import httpx
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from graspdb_geometry import meshes

GLB = {"Content-Type": "model/gltf-binary"}
#: Straight down onto the rim of a tube of 80 mm, one finger in it; the same 0.2 m above it; and one whose
#: fingers and palm are deep in a block of a metre.
DOWN = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]]).as_quat().tolist()
ON_THE_RIM, ABOVE, DEEP = [0.038, 0.0, 0.05], [0.038, 0.0, 0.25], [0.1, 0.2, 0.1]


def put(http: httpx.Client, slug: str, mesh: trimesh.Trimesh, parts: trimesh.Trimesh | None) -> None:
    assert http.post("/objects", json={"id": slug, "mass_kg": 0.2}).status_code == 201
    stl = {"Content-Type": "model/stl"}
    stored = http.put(f"/objects/{slug}/mesh", content=mesh.export(file_type="stl"), headers=stl)
    assert stored.status_code == 200, stored.text
    if parts is not None:
        glb = meshes.parts_to_glb([(np.array(parts.vertices), np.array(parts.faces))])
        path = f"/objects/{slug}/convex-parts?accept_deviation=true"
        assert http.put(path, content=glb, headers=GLB).status_code == 200


def free(http: httpx.Client, slug: str, *positions: list[float]) -> list[bool]:
    body: dict[str, Any] = {
        "poses": {"position": positions, "quaternion_xyzw": [DOWN] * len(positions)},
        "gripper": "pg70",
        "include": ["collision_free"],
    }
    answer = http.post(f"/objects/{slug}/likelihood", json=body)
    assert answer.status_code == 200, answer.text
    found: list[bool] = answer.json()["collision_free"]
    return found


def tube() -> trimesh.Trimesh:
    return trimesh.creation.annulus(r_min=0.036, r_max=0.04, height=0.1, sections=64)


def test_a_finger_in_a_tube_is_free_though_its_parts_fill_it(sqlite_http: httpx.Client) -> None:
    put(sqlite_http, "tube", tube(), tube().convex_hull)
    assert free(sqlite_http, "tube", ON_THE_RIM, ABOVE) == [True, True]
    # A robot has held it so: the best grasp may be that one.
    trial = {"position": ON_THE_RIM, "quaternion_xyzw": DOWN, "outcome": "success", "gripper": "pg70"}
    assert sqlite_http.post("/objects/tube/trials", json=trial).status_code == 201
    best = sqlite_http.get("/objects/tube/best-grasp?collision_free=true").json()
    assert best["status"] == "ok"
    (grasp,) = best["grasps"]
    assert grasp["collision_free"]
    np.testing.assert_allclose(grasp["position"], ON_THE_RIM, atol=1e-3)
    # Its fingers close on the wall, which for the parts is in one of them.
    assert grasp["width_m"] == pytest.approx(0.004, abs=2e-3)


def test_parts_are_the_object_where_it_has_no_mesh(sqlite_http: httpx.Client) -> None:
    assert sqlite_http.post("/objects", json={"id": "parts"}).status_code == 201
    hull = tube().convex_hull
    glb = meshes.parts_to_glb([(np.array(hull.vertices), np.array(hull.faces))])
    assert sqlite_http.put("/objects/parts/convex-parts", content=glb, headers=GLB).status_code == 200
    assert free(sqlite_http, "parts", ON_THE_RIM, ABOVE) == [False, True]


@pytest.mark.parametrize("open_mesh", [False, True])
def test_deep_inside_of_a_solid_is_a_collision_where_that_can_be_known(
    sqlite_http: httpx.Client, open_mesh: bool
) -> None:
    block = trimesh.creation.box((1.0, 1.0, 1.0)).subdivide()
    mesh = block.copy()
    if open_mesh:
        # A side is missing: more than is filled in good faith.
        mesh.update_faces(block.face_normals[:, 0] < 0.5)
    put(sqlite_http, "block", mesh, None)
    assert free(sqlite_http, "block", DEEP, [0.0, 0.0, 0.51]) == [open_mesh, False]
    if open_mesh:
        # Without that side their surface is up to half a metre off: whether it is solid nothing tells.
        hull = meshes.parts_to_glb([(np.array(block.vertices), np.array(block.faces))])
        path = "/objects/block/convex-parts"
        assert sqlite_http.put(path, content=hull, headers=GLB).json()["deviates"]
        assert free(sqlite_http, "block", DEEP) == [True]


def test_parts_near_an_open_mesh_tell_its_inside(sqlite_http: httpx.Client) -> None:
    block = trimesh.creation.box((0.3, 0.3, 0.3))
    lid = block.copy()
    lid.update_faces(block.face_normals[:, 2] > 0.5)
    block.update_faces(block.face_normals[:, 2] < 0.5)
    # As a scanner leaves it: 2 mm apart all around.
    mesh = trimesh.util.concatenate([block, lid.apply_translation([0, 0, 0.002])])
    put(sqlite_http, "scan", mesh, None)
    assert not sqlite_http.get("/objects/scan").json()["mesh"]["watertight"]
    assert free(sqlite_http, "scan", [0.0, 0.0, 0.0]) == [True]
    hull = mesh.convex_hull
    glb = meshes.parts_to_glb([(np.array(hull.vertices), np.array(hull.faces))])
    parts = sqlite_http.put("/objects/scan/convex-parts", content=glb, headers=GLB).json()
    assert not parts["deviates"]
    assert parts["deviation_m"] <= 0.002
    assert free(sqlite_http, "scan", [0.0, 0.0, 0.0], [0.0, 0.0, 0.3]) == [False, True]
