"""Meshes and convex parts: checked, measured, kept while trials depend on them."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest

from graspdb_geometry import meshes

Serve = Callable[..., str]
STL = {"Content-Type": "model/stl"}
GLB = {"Content-Type": "model/gltf-binary"}
GRASP = {"position": [0, 0, 0.1], "quaternion_xyzw": [0, 0, 0, 1], "outcome": True}
_FACES = (
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
)  # fmt: skip


def _box(size: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0)) -> meshes.Part:
    """Vertices and faces of a box: binary order of the corners, z fastest."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    return corners * size + centre, np.array(_FACES)


def _stl(*parts: meshes.Part) -> bytes:
    triangles = np.concatenate([vertices[faces] for vertices, faces in parts]).astype("<f4")
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *triangle.ravel(), 0) for triangle in triangles)
    return b"\0" * 80 + struct.pack("<I", len(triangles)) + body


BOX = _stl(_box((0.04, 0.06, 0.1)))
DUMBBELL = [_box((0.04, 0.04, 0.04), (0, 0, z)) for z in (-0.05, 0.05)]
# A cavity so thin that it changes no measure, but its body is not convex any more.
_SLIT = _box((0.004, 0.004, 1e-6), (0, 0, -0.05))
DENTED = [*DUMBBELL, (_SLIT[0], _SLIT[1][:, ::-1])]


@pytest.fixture
def box(http: httpx.Client) -> httpx.Client:
    """A client of a service that has an object ``box`` without a mesh."""
    http.post("/objects", json={"id": "box"})
    return http


def test_mesh_is_measured_and_read_back(box: httpx.Client) -> None:
    answer = box.put("/objects/box/mesh", params={"unit": "m"}, content=BOX, headers=STL)
    assert answer.status_code == 200, answer.text
    info = answer.json()
    assert info["bounding_box"]["upper"] == pytest.approx([0.02, 0.03, 0.05], abs=1e-6)
    assert info["volume_m3"] == pytest.approx(0.04 * 0.06 * 0.1, rel=1e-5)
    assert (info["watertight"], info["convex"], info["faces"], info["vertices"]) == (True, True, 12, 8)
    # A solid box of unit density: V (b^2 + c^2) / 12.
    volume = 0.04 * 0.06 * 0.1
    expected = [volume * s / 12 for s in (0.06**2 + 0.1**2, 0.04**2 + 0.1**2, 0.04**2 + 0.06**2)]
    assert np.diag(info["inertia_m5"]) == pytest.approx(expected, rel=1e-5)
    assert box.get("/objects/box").json()["mesh"] == info
    back = box.get("/objects/box/mesh")
    assert back.content == BOX
    assert back.headers["content-type"] == "model/stl"
    assert info["sha256"] in back.headers["etag"]
    assert (back.headers["mesh-unit"], back.headers["mesh-scale"]) == ("m", "1.0")
    assert box.get("/objects/box/mesh", headers={"If-None-Match": back.headers["etag"]}).status_code == 304


def test_unit_scales_to_metres(box: httpx.Client) -> None:
    stl = _stl(_box((40, 60, 100)))
    info = box.put("/objects/box/mesh?unit=mm", content=stl, headers=STL).json()
    assert info["bounding_box"]["upper"] == pytest.approx([0.02, 0.03, 0.05])
    assert info["volume_m3"] == pytest.approx(0.04 * 0.06 * 0.1)
    assert info["unit"] == "mm"


@pytest.mark.parametrize(("unit", "scale"), [("mm", 0.037), ("m", 2.5), ("in", 1.0)])
def test_a_scale_beside_the_unit(box: httpx.Client, unit: str, scale: float) -> None:
    """Lengths grow with it, volumes with its cube, inertia at unit density with its fifth power."""
    factor = meshes.UNITS[unit] * scale
    size = np.array([0.04, 0.06, 0.1])
    stl = _stl(_box(tuple(size / factor)))
    info = box.put(f"/objects/box/mesh?unit={unit}&scale={scale}", content=stl, headers=STL).json()
    assert info["bounding_box"]["upper"] == pytest.approx(size / 2, rel=1e-6)
    volume = float(size.prod())
    assert info["volume_m3"] == pytest.approx(volume, rel=1e-5)
    expected = [volume * (size @ size - side**2) / 12 for side in size]
    assert np.diag(info["inertia_m5"]) == pytest.approx(expected, rel=1e-5)
    assert (info["unit"], info["scale"]) == (unit, scale)
    back = box.get("/objects/box/mesh")
    assert back.content == stl
    assert (back.headers["mesh-unit"], float(back.headers["mesh-scale"])) == (unit, scale)
    understood = box.get("/objects/box/mesh?triangles=true")
    assert (understood.headers["content-type"], understood.headers["mesh-unit"]) == ("model/stl", "m")
    assert meshes.load(understood.content, "model/stl").vertices.max(axis=0) == pytest.approx(
        size / 2, rel=1e-6
    )
    assert understood.headers["etag"] != back.headers["etag"]
    # Its own convex part is in metres, whatever the mesh's coordinates were.
    (part,) = meshes.parts_from_glb(box.get("/objects/box/convex-parts").content)
    assert np.abs(part[0]).max(axis=0) == pytest.approx(size / 2, abs=1e-6)


def test_the_collision_test_is_of_the_scaled_mesh(box: httpx.Client) -> None:
    """A gripper from above meets what is 40 mm high, not what the unscaled bytes would be."""
    upright = {"quaternion_xyzw": "1,0,0,0", "gripper": "panda", "include": "collision_free"}

    def free(slug: str, height: float) -> bool:
        box.post(f"/objects/{slug}/trials", json={**GRASP, "gripper": "panda"})
        asked = {**upright, "position": f"0,0,{height}"}
        answer = box.get(f"/objects/{slug}/likelihood", params=asked)
        assert answer.status_code == 200, answer.text
        return bool(answer.json()["collision_free"][0])

    # Wider than any jaw, so that fingers come down on its top; of what has a cavity the surface is tested.
    plate, slit = _box((0.2, 0.2, 0.04)), _box((0.01, 0.01, 0.001))
    for slug, parts in (("plate", [plate]), ("hollow", [plate, (slit[0], slit[1][:, ::-1])])):
        box.post("/objects", json={"id": slug})
        grown = [(vertices / 0.5, faces) for vertices, faces in parts]
        put = box.put(f"/objects/{slug}/mesh?scale=0.5", content=_stl(*grown), headers=STL)
        assert put.status_code == 200, put.text
        assert free(slug, 0.03)
        assert not free(slug, 0.015)


def test_another_scale_is_another_mesh(box: httpx.Client) -> None:
    first = box.put("/objects/box/mesh?scale=1", content=BOX, headers=STL)
    tag = box.get("/objects/box/mesh").headers["etag"]
    again = box.put("/objects/box/mesh", content=BOX, headers=STL)
    assert again.json() == first.json()
    assert box.get("/objects/box").json()["revision"] == 1
    assert box.put("/objects/box/mesh?scale=2", content=BOX, headers=STL).json()["scale"] == 2.0
    assert box.get("/objects/box/mesh", headers={"If-None-Match": tag}).status_code == 200
    box.post("/objects/box/trials", json=GRASP)
    refused = box.put("/objects/box/mesh?scale=1", content=BOX, headers=STL)
    assert refused.json()["type"] == "urn:graspdb:problem:mesh-in-use"
    for wrong in ("0", "-1", "nan", "inf", "1e7", "x"):
        refused = box.put(f"/objects/box/mesh?scale={wrong}", content=BOX, headers=STL)
        assert refused.status_code == 422, wrong
        assert refused.json()["errors"][0]["field"] == "scale"


def test_convex_mesh_is_its_own_part(box: httpx.Client) -> None:
    box.put("/objects/box/mesh", content=BOX, headers=STL)
    info = box.get("/objects/box").json()["convex_parts"]
    assert info["parts"] == 1
    assert info["volume_m3"] == pytest.approx(0.04 * 0.06 * 0.1, rel=1e-5)
    (part,) = meshes.parts_from_glb(box.get("/objects/box/convex-parts").content)
    assert np.abs(part[0]).max(axis=0) == pytest.approx([0.02, 0.03, 0.05], abs=1e-6)


def test_convex_bodies_are_the_parts_of_their_mesh(box: httpx.Client) -> None:
    info = box.put("/objects/box/mesh", content=_stl(*DUMBBELL), headers=STL).json()
    assert info["warnings"] == [
        "it has 2 bodies that do not touch: they are weighed and moved as one rigid object"
    ]
    parts = box.get("/objects/box").json()["convex_parts"]
    assert (parts["parts"], parts["warnings"]) == (2, [])
    found = meshes.parts_from_glb(box.get("/objects/box/convex-parts").content)
    assert [part[0].mean(axis=0)[2] for part in found] == pytest.approx([-0.05, 0.05], abs=1e-6)
    # Nobody needs to make any.
    box.patch("/objects/box", json={"mass_kg": 0.2})
    sweep = box.post("/objects/box/sweeps", json={"grid": {"max_poses": 10}}).json()
    assert sweep["waiting_for"] is None


def test_bodies_that_overlap_or_stand_twice_weigh_once(box: httpx.Client) -> None:
    half = _box((0.04, 0.06, 0.1), (0.02, 0, 0))
    info = box.put("/objects/box/mesh", content=_stl(_box((0.04, 0.06, 0.1)), half, half), headers=STL).json()
    assert info["volume_m3"] == pytest.approx(0.06 * 0.06 * 0.1, rel=1e-5)
    assert info["centre_of_mass"] == pytest.approx([0.01, 0, 0], abs=1e-7)
    volume = 0.06 * 0.06 * 0.1
    expected = [volume * s / 12 for s in (0.06**2 + 0.1**2, 0.06**2 + 0.1**2, 2 * 0.06**2)]
    assert np.diag(info["inertia_m5"]) == pytest.approx(expected, rel=1e-5)
    assert any("count once" in warning for warning in info["warnings"])
    assert any("overlap" in warning for warning in info["warnings"])
    assert box.get("/objects/box").json()["convex_parts"]["parts"] == 2


def test_given_parts_are_checked_and_read_back(box: httpx.Client) -> None:
    box.put("/objects/box/mesh", content=_stl(*DENTED), headers=STL)
    assert box.get("/objects/box").json()["convex_parts"] is None
    assert box.get("/objects/box/convex-parts").status_code == 404
    glb = meshes.parts_to_glb(DUMBBELL)
    answer = box.put("/objects/box/convex-parts", content=glb, headers=GLB)
    assert answer.status_code == 200, answer.text
    info = answer.json()
    assert (info["parts"], info["warnings"]) == (2, [])
    assert info["volume_m3"] == pytest.approx(2 * 0.04**3, rel=1e-5)
    back = box.get("/objects/box/convex-parts")
    assert (back.content, back.headers["content-type"]) == (glb, "model/gltf-binary")
    assert back.headers["etag"] == f'"{info["sha256"]}"'
    assert box.get("/objects/box").json()["convex_parts"] == info


def test_parts_of_another_size_are_refused_with_the_ways_out(box: httpx.Client) -> None:
    box.put("/objects/box/mesh", content=_stl(*DENTED), headers=STL)
    wrong = meshes.parts_to_glb([(vertices * 1.1, faces) for vertices, faces in DUMBBELL])
    refused = box.put("/objects/box/convex-parts", content=wrong, headers=GLB)
    assert refused.status_code == 422
    problem = refused.json()
    assert problem["type"].endswith(":convex-parts-deviate")
    for said in ("133.1% of its", "bounding box", "in metres?", "finer", "worker", "?accept_deviation=true"):
        assert said in problem["title"], said
    # 1 % of 140 mm; the corners are 2.2, 2.2 and 7 mm off.
    assert problem["accepted_m"] == pytest.approx(0.0014)
    assert problem["deviation_m"] == pytest.approx(0.0075, abs=0.001)
    assert problem["volume_share"] == pytest.approx(1.331, rel=1e-4)
    assert box.get("/objects/box").json()["convex_parts"] is None
    taken = box.put("/objects/box/convex-parts?accept_deviation=true", content=wrong, headers=GLB)
    assert taken.status_code == 200, taken.text
    info = taken.json()
    assert info["deviates"]
    assert info["volume_share"] == pytest.approx(1.331, rel=1e-4)
    assert ["bounding box" in info["warnings"][0], "133.1%" in info["warnings"][1]] == [True, True]
    # And every sweep says so.
    box.patch("/objects/box", json={"mass_kg": 0.2})
    sweep = box.post("/objects/box/sweeps", json={"grid": {"max_poses": 10}}).json()
    assert any("133.1% of its volume" in warning for warning in sweep["warnings"])


def test_parts_that_came_before_their_mesh_are_measured_with_it(box: httpx.Client) -> None:
    swollen = meshes.parts_to_glb([(vertices * 1.1, faces) for vertices, faces in DUMBBELL])
    first = box.put("/objects/box/convex-parts", content=swollen, headers=GLB).json()
    assert (first["deviation_m"], first["warnings"]) == (None, [])
    assert box.put("/objects/box/mesh", content=_stl(*DENTED), headers=STL).status_code == 200
    parts = box.get("/objects/box").json()["convex_parts"]
    assert parts["sha256"] == first["sha256"]
    assert parts["deviates"]
    assert parts["deviation_m"] == pytest.approx(0.0075, abs=0.001)


def test_hollow_part_is_refused_by_number(box: httpx.Client) -> None:
    vertices, faces = DUMBBELL[0]
    dented = vertices.copy()
    dented[0] *= 0.3
    glb = meshes.parts_to_glb([DUMBBELL[1], (dented, faces)])
    answer = box.put("/objects/box/convex-parts", content=glb, headers=GLB)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"].startswith("parts")
    assert box.get("/objects/box").json()["convex_parts"] is None


def test_another_mesh_replaces_the_first_and_its_parts(box: httpx.Client) -> None:
    box.put("/objects/box/mesh", content=BOX, headers=STL)
    before = box.get("/objects/box").json()
    assert box.put("/objects/box/mesh", content=_stl(*DENTED), headers=STL).status_code == 200
    after = box.get("/objects/box").json()
    assert after["convex_parts"] is None
    assert after["revision"] == after["epoch"] == before["revision"] + 1
    same = box.put("/objects/box/mesh", content=_stl(*DENTED), headers=STL)
    assert same.status_code == 200
    assert box.get("/objects/box").json()["revision"] == after["revision"]


def test_mesh_stays_once_there_are_trials(box: httpx.Client) -> None:
    box.put("/objects/box/mesh", content=BOX, headers=STL)
    batch = box.post("/objects/box/trials", json=GRASP).json()["batch"]
    other = _stl(_box((0.05, 0.06, 0.1)))
    refused = box.put("/objects/box/mesh", content=other, headers=STL)
    assert refused.status_code == 409
    assert refused.json()["type"].endswith(":mesh-in-use")
    assert box.put("/objects/box/mesh", content=BOX, headers=STL).status_code == 200
    # The same bytes in another unit are another mesh.
    assert box.put("/objects/box/mesh?unit=cm", content=BOX, headers=STL).status_code == 409
    assert box.get("/objects/box/mesh").content == BOX
    box.delete(f"/objects/box/batches/{batch}")
    assert box.put("/objects/box/mesh", content=other, headers=STL).status_code == 200


def test_first_mesh_may_follow_trials(box: httpx.Client) -> None:
    box.post("/objects/box/trials", json=GRASP)
    assert box.put("/objects/box/mesh", content=BOX, headers=STL).status_code == 200


def test_mesh_and_parts_stay_once_there_is_a_sweep(box: httpx.Client) -> None:
    box.patch("/objects/box", json={"mass_kg": 0.2})
    box.put("/objects/box/mesh", content=BOX, headers=STL)
    assert box.post("/objects/box/sweeps", json={"grid": {"max_poses": 10}}).status_code == 202
    parts = box.get("/objects/box/convex-parts").content
    other = meshes.parts_to_glb(DUMBBELL)
    assert box.put("/objects/box/convex-parts", content=other, headers=GLB).status_code == 409
    assert box.put("/objects/box/convex-parts", content=parts, headers=GLB).status_code == 200
    assert box.put("/objects/box/mesh", content=_stl(*DUMBBELL), headers=STL).status_code == 409


def test_objects_share_equal_meshes(box: httpx.Client) -> None:
    box.post("/objects", json={"id": "twin"})
    for name in ("box", "twin"):
        box.put(f"/objects/{name}/mesh", content=BOX, headers=STL)
    box.delete("/objects/box")
    assert box.get("/objects/twin/mesh").content == BOX
    assert box.get("/objects/twin/convex-parts").status_code == 200


NAN_STL = bytearray(BOX)
NAN_STL[96:100] = struct.pack("<f", float("nan"))
HUGE_STL = bytearray(BOX)
HUGE_STL[96:100] = struct.pack("<f", 3e38)


UNUSABLE: list[tuple[bytes, str, str, int, str | None]] = [
    (b"", "model/stl", "m", 422, "mesh"),
    (BOX[:-20], "model/stl", "m", 422, "mesh"),
    (bytes(NAN_STL), "model/stl", "m", 422, "mesh"),
    (bytes(HUGE_STL), "model/stl", "m", 422, "mesh"),
    (b"\0" * 80 + struct.pack("<I", 2**32 - 1), "model/stl", "m", 422, "mesh"),
    (BOX, "model/obj", "m", 422, "mesh"),
    (BOX, "model/gltf-binary", "m", 422, "mesh"),
    (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "model/obj", "m", 422, "mesh"),
    (b"v 0 0 0\nv 1e308 0 0\nv 0 1 0\nf 1 2 3\n", "model/obj", "m", 422, "mesh"),
    (b"PK\x03\x04", "model/3mf", "m", 415, None),
    (BOX, "", "m", 415, None),
    (BOX, "application/json", "m", 415, None),
    (BOX, "model/stl", "ft", 422, "unit"),
    (_stl(_box((40, 60, 100))), "model/stl", "m", 422, "mesh"),
]


def test_unusable_mesh_is_refused(sqlite_http: httpx.Client) -> None:
    sqlite_http.post("/objects", json={"id": "box"})
    for content, media, unit, status, field in UNUSABLE:
        headers = {"Content-Type": media} if media else {}
        answer = sqlite_http.put(f"/objects/box/mesh?unit={unit}", content=content, headers=headers)
        assert answer.status_code == status, (media, unit, content[:80], answer.text)
        assert answer.headers["content-type"] == "application/problem+json"
        if field:
            assert [error["field"] for error in answer.json()["errors"]] == [field]
    after = sqlite_http.get("/objects/box").json()
    assert (after["mesh"], after["revision"]) == (None, 0)


def test_mesh_over_the_limit_is_413(sqlite_url: str, serve: Serve) -> None:
    options: dict[str, Any] = {"max_mesh_bytes": 1_000}
    with httpx.Client(base_url=serve(sqlite_url, **options)) as http:
        http.post("/objects", json={"id": "box"})
        answer = http.put(
            "/objects/box/mesh", content=b"v 0 0 0\n" * 1_000, headers={"Content-Type": "model/obj"}
        )
    assert answer.status_code == 413
    assert answer.json()["limit"] == 1_000


def test_mesh_that_takes_too_long_is_refused(sqlite_url: str, serve: Serve) -> None:
    options: dict[str, Any] = {"max_mesh_seconds": 0.05}
    with httpx.Client(base_url=serve(sqlite_url, **options)) as http:
        http.post("/objects", json={"id": "box"})
        answer = http.put("/objects/box/mesh", content=BOX, headers=STL)
        assert answer.status_code == 422
        assert answer.json()["type"].endswith(":mesh-not-usable")
        assert http.get("/livez").status_code == 200


def test_mesh_of_a_missing_object_is_404(box: httpx.Client) -> None:
    assert box.put("/objects/none/mesh", content=BOX, headers=STL).status_code == 404
    assert box.get("/objects/none/mesh").status_code == 404
    assert box.get("/objects/box/mesh").status_code == 404
