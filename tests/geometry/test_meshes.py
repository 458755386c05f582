"""Reading, checking and measuring users' meshes; hostile files must end as a MeshError."""

from __future__ import annotations

import io
import json
import struct
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from graspdb.examples import EXAMPLES, example
from graspdb_geometry import meshes
from graspdb_geometry.meshes import MeshError

FORMATS = {"model/stl": "stl", "model/obj": "obj", "model/ply": "ply", "model/gltf-binary": "glb"}


def box(extents: Any = (0.1, 0.2, 0.3)) -> trimesh.Trimesh:
    return trimesh.creation.box(extents=extents)


def export(mesh: trimesh.Trimesh, kind: str) -> bytes:
    data = mesh.export(file_type=kind)
    return data.encode() if isinstance(data, str) else data


@pytest.mark.parametrize("media_type", FORMATS)
def test_every_format_gives_the_same_solid(media_type: str) -> None:
    lump = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    lump.apply_scale([1, 2, 3])
    lump.apply_translation([0.01, -0.02, 0.03])
    answer = meshes.inspect(export(lump, FORMATS[media_type]), media_type)
    found = answer.properties
    assert found.watertight
    assert found.convex
    assert found.triangles == len(lump.faces)
    np.testing.assert_allclose([found.lower, found.upper], lump.bounds, atol=1e-7)
    assert found.volume_m3 == pytest.approx(lump.volume, rel=1e-5)
    assert found.area_m2 == pytest.approx(lump.area, rel=1e-5)
    np.testing.assert_allclose(found.centre_of_mass, lump.center_mass, atol=1e-7)
    np.testing.assert_allclose(found.inertia, lump.moment_inertia, rtol=1e-4, atol=1e-10)
    assert found.warnings == []
    assert len(answer.mesh.vertices) == len(lump.vertices)


def test_ascii_variants() -> None:
    cube = box()
    for media_type, data in (
        ("model/stl", cube.export(file_type="stl_ascii")),
        ("model/ply", cube.export(file_type="ply", encoding="ascii")),
    ):
        raw = data.encode() if isinstance(data, str) else data
        assert meshes.inspect(raw, media_type).properties.volume_m3 == pytest.approx(0.006)


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254)])
def test_units_scale_everything(unit: str, metres: float) -> None:
    data = export(box(np.array([0.1, 0.2, 0.3]) / metres), "stl")
    found = meshes.inspect(data, "model/stl", unit).properties
    np.testing.assert_allclose(found.upper, [0.05, 0.1, 0.15], rtol=1e-6)
    assert found.volume_m3 == pytest.approx(0.006, rel=1e-6)
    assert found.inertia is not None
    # A box's inertia at unit density: m / 12 (b^2 + c^2).
    assert found.inertia[0][0] == pytest.approx(0.006 / 12 * (0.04 + 0.09), rel=1e-6)


def test_inertia_does_not_depend_on_where_the_mesh_lies() -> None:
    cube = box()
    near = meshes.inspect(export(cube, "ply"), "model/ply").properties
    cube.apply_translation([40, -30, 20])
    far = meshes.inspect(export(cube, "ply"), "model/ply").properties
    np.testing.assert_allclose(near.inertia, far.inertia, rtol=1e-4, atol=1e-9)
    assert any("origin" in warning for warning in far.warnings)


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_are_measured_right(name: str) -> None:
    thing = example(name)
    found = meshes.inspect(thing.stl(), "model/stl").properties
    assert found.watertight
    assert found.convex == (name == "cone")
    # The mug's handle reaches into its wall, which counts once in the mesh.
    assert found.volume_m3 == pytest.approx(thing.mass_kg / 1000, rel=5e-3 if name == "mug" else 1e-5)
    np.testing.assert_allclose([found.lower, found.upper], thing.bounds, atol=1e-8)


def test_an_open_mesh_is_told_apart_and_has_no_volume() -> None:
    cube = box()
    # A whole side is missing: is it a box or an open crate?
    cube.update_faces(np.abs(cube.face_normals[:, 0] - 1) > 0.1)
    found = meshes.inspect(export(cube, "obj"), "model/obj").properties
    assert not found.watertight
    assert not found.convex
    assert found.volume_m3 is None
    assert found.inertia is None
    assert any("watertight" in warning for warning in found.warnings)
    assert any("holes are larger than 5%" in warning for warning in found.warnings)


def test_an_inside_out_solid_is_turned() -> None:
    cube = box()
    cube.invert()
    found = meshes.inspect(export(cube, "obj"), "model/obj").properties
    assert found.volume_m3 == pytest.approx(0.006)
    assert any("inside out" in warning for warning in found.warnings)


def test_a_cavity_or_a_dent_is_not_convex() -> None:
    hollow = trimesh.util.concatenate([box(), box((0.05, 0.05, 0.05))])
    hollow.faces[12:] = hollow.faces[12:, ::-1]
    found = meshes.inspect(export(hollow, "ply"), "model/ply").properties
    assert found.watertight
    assert found.volume_m3 == pytest.approx(0.006 - 0.000125, rel=1e-5)
    assert not found.convex


def test_suspicious_units_are_warned_of_or_refused() -> None:
    assert any(
        "mm" in w for w in meshes.inspect(export(box((3, 1, 1)), "stl"), "model/stl").properties.warnings
    )
    tiny = meshes.inspect(export(box((3, 1, 1)), "stl"), "model/stl", "mm").properties
    assert any("unit=m" in w for w in tiny.warnings)
    with pytest.raises(MeshError, match="millimetres"):
        meshes.load(export(box((80, 90, 90)), "stl"), "model/stl")
    with pytest.raises(MeshError, match="less than"):
        meshes.load(export(box((0.08, 0.09, 0.09)), "stl"), "model/stl", "mm")


# ---------------------------------------------------------------------------------- refused content


def obj(*lines: str) -> bytes:
    return "\n".join(lines).encode()


TRIANGLE = ("v 0 0 0", "v 0.1 0 0", "v 0 0.1 0")


@pytest.mark.parametrize(
    ("data", "media_type", "message"),
    [
        (b"", "model/stl", "empty"),
        (b"hello", "model/stl", "not STL"),
        (b"\0" * 84, "model/stl", "no triangles"),
        (b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0", "model/stl", "cut off"),
        (b"solid x\nvertex 0 0 a\nvertex 0 0 1\nvertex 0 1 1\nendfacet\nendsolid", "model/stl", "number"),
        (b"solid x\nvertex 0 0 0\nvertex 0 0 1\nendfacet\nendsolid", "model/stl", "three vertices"),
        (export(box(), "stl")[:-1], "model/stl", "cut off"),
        (export(box(), "glb"), "model/stl", "not STL"),
        (export(box(), "stl"), "model/gltf-binary", "not GLB"),
        (export(box(), "stl"), "model/obj", "not OBJ"),
        (export(box(), "stl"), "model/ply", "not PLY"),
        (b"just words\nof text", "model/obj", "not OBJ"),
        (obj(*TRIANGLE), "model/obj", "not OBJ"),
        (obj(*TRIANGLE, "f 1 2 4"), "model/obj", "does not exist"),
        (obj(*TRIANGLE, "f 1 2 -4"), "model/obj", "does not exist"),
        (obj(*TRIANGLE, "f 1 2 0"), "model/obj", "line 4"),
        (obj(*TRIANGLE, "f 1 2"), "model/obj", "line 4"),
        (obj(*TRIANGLE, "f 1 2 x"), "model/obj", "line 4"),
        (obj(*TRIANGLE, "f 1 2 " + "9" * 30), "model/obj", "does not exist"),
        (obj("v 0 0", *TRIANGLE, "f 1 2 3"), "model/obj", "line 1"),
        (obj("v nan 0 0", *TRIANGLE, "f 1 2 3"), "model/obj", "finite"),
        (obj("v inf 0 0", *TRIANGLE, "f 2 3 4"), "model/obj", "finite"),
        (obj("v 1e308 0 0", "v -1e308 0 0", "v 0 1 0", "f 1 2 3"), "model/obj", "extent"),
        (obj("v 1e5 0 0", "v 100000.1 0 0", "v 1e5 0.1 0", "f 1 2 3"), "model/obj", "origin"),
        (obj(*TRIANGLE, "f 1 1 2"), "model/obj", "area"),
        (b"ply\nformat ascii 1.0\nelement vertex 3", "model/ply", "end_header"),
        (b"ply\nformat ascii 1.0\nelement vertex 999999999\nend_header\n", "model/ply", "declares more"),
        (b"ply\nformat ascii 1.0\nelement vertex -5\nend_header\n", "model/ply", "declares more"),
        (export(box(), "ply")[:-10], "model/ply", "cut off"),
        (export(box(), "glb")[:-4], "model/gltf-binary", "declares"),
    ],
)
def test_broken_and_foreign_files_are_refused(data: bytes, media_type: str, message: str) -> None:
    with pytest.raises(MeshError, match=message) as caught:
        meshes.load(data, media_type)
    assert caught.value.field == "mesh"


def test_unknown_media_type_and_unit() -> None:
    with pytest.raises(MeshError) as caught:
        meshes.load(b"x", "model/3mf")
    assert caught.value.field == "content_type"
    with pytest.raises(MeshError) as caught:
        meshes.load(b"x", "model/stl", "ft")
    assert caught.value.field == "unit"
    assert meshes.load(export(box(), "stl"), "Model/STL; charset=binary").faces.shape == (12, 3)


def test_triangles_are_limited_before_they_are_built() -> None:
    lump = trimesh.creation.icosphere(subdivisions=3)
    for media_type, kind in FORMATS.items():
        with pytest.raises(MeshError, match="more than 100 triangles"):
            meshes.load(export(lump, kind), media_type, max_triangles=100)
    wheel = obj(*(f"v {k} {k * k} 0" for k in range(200)), "f " + " ".join(str(k + 1) for k in range(200)))
    with pytest.raises(MeshError, match="more than 100"):
        meshes.load(wheel, "model/obj", max_triangles=100)


def edit_glb(data: bytes, change: Any) -> bytes:
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    document = change(document) or document
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<III", 0x46546C67, 2, 20 + len(text) + len(rest))
    return head + struct.pack("<II", len(text), 0x4E4F534A) + text + rest


def setter(*path: Any) -> Any:
    *keys, last, value = path

    def change(document: Any) -> None:
        entry = document
        for key in keys:
            entry = entry[key]
        entry[last] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (setter("accessors", 0, "count", 10**9), "beyond"),
        (setter("accessors", 1, "count", 7), "within a triangle"),
        (setter("accessors", 0, "byteOffset", 10**9), "beyond"),
        (setter("accessors", 0, "count", -1), "integer"),
        (setter("accessors", 0, "count", 1.5), "integer"),
        (setter("accessors", 0, "componentType", 5125), "type"),
        (setter("accessors", 0, "type", "VEC2"), "type"),
        (setter("accessors", 0, "sparse", {}), "type"),
        (setter("bufferViews", 0, "byteLength", 10**9), "beyond"),
        (setter("bufferViews", 0, "byteStride", 1), "beyond"),
        (setter("bufferViews", 0, "buffer", 1), "does not exist"),
        (setter("buffers", 0, "uri", "file:///etc/passwd"), "outside"),
        (setter("extensionsRequired", ["KHR_draco_mesh_compression"]), "extensions"),
        (setter("meshes", 0, "primitives", 0, "mode", 9), "mode 9"),
        (setter("meshes", 0, "primitives", 0, "attributes", {}), "POSITION"),
        (setter("meshes", 0, "primitives", 0, "attributes", "POSITION", 99), "does not exist"),
        (setter("nodes", 0, "mesh", 4), "does not exist"),
        (setter("nodes", 0, "children", [0]), "two parents"),
        (setter("nodes", 0, "matrix", [1] * 15), "16 numbers"),
        (setter("nodes", 0, "scale", [1, 1, "x"]), "3 numbers"),
        (setter("nodes", 0, "translation", [float("nan"), 0, 0]), "finite"),
        (setter("nodes", 7), "not a list"),
        (setter("scenes", 0, "nodes", [0, 0]), "two parents"),
        (lambda document: [document], "not an object"),
    ],
)
def test_lying_glbs_are_refused(change: Any, message: str) -> None:
    good = meshes.parts_to_glb([(box().vertices, box().faces)])
    assert meshes.load(good, "model/gltf-binary").faces.shape == (12, 3)
    with pytest.raises(MeshError, match=message):
        meshes.load(edit_glb(good, change), "model/gltf-binary")


def test_glb_instances_can_not_multiply_triangles_without_bound() -> None:
    def many(document: Any) -> None:
        document["nodes"] = [{"mesh": 0}] * 20_000
        document["scenes"] = [{"nodes": list(range(20_000))}]

    bomb = edit_glb(meshes.parts_to_glb([(box().vertices, box().faces)]), many)
    with pytest.raises(MeshError, match="triangles"):
        meshes.load(bomb, "model/gltf-binary", max_triangles=100_000)


def test_glb_nodes_place_their_meshes() -> None:
    def place(document: Any) -> None:
        document["nodes"] = [
            {"children": [1], "translation": [1, 0, 0]},
            {"mesh": 0, "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)], "scale": [1, -1, 2]},
        ]

    found = meshes.inspect(
        edit_glb(meshes.parts_to_glb([(box().vertices, box().faces)]), place), "model/gltf-binary"
    ).properties
    np.testing.assert_allclose(found.lower, [0.9, -0.05, -0.3], atol=1e-7)
    np.testing.assert_allclose(found.upper, [1.1, 0.05, 0.3], atol=1e-7)
    # The mirroring scale would turn it inside out if the triangles were not turned with it.
    assert found.volume_m3 == pytest.approx(0.012, rel=1e-5)


def test_trimesh_reads_what_we_write_and_we_what_it_writes() -> None:
    thing = example("mug")
    scene = trimesh.load_scene(io.BytesIO(meshes.parts_to_glb(thing.parts)), file_type="glb")
    assert len(scene.geometry) == 33
    ours = meshes.parts_from_glb(thing.parts_glb())
    for (vertices, faces), (original, _) in zip(ours, thing.parts, strict=True):
        assert faces.shape[1] == 3
        np.testing.assert_allclose(vertices.min(axis=0), original.min(axis=0), atol=1e-8)
        np.testing.assert_allclose(vertices.max(axis=0), original.max(axis=0), atol=1e-8)


# --------------------------------------------------------------------------------------------- parts


def test_parts_survive_the_round_trip_and_the_bytes_are_stable() -> None:
    parts = list(example("screwdriver").parts)
    data = meshes.parts_to_glb(parts)
    again = meshes.parts_from_glb(data)
    assert len(again) == len(parts)
    assert meshes.parts_to_glb(again) == meshes.parts_to_glb(
        meshes.parts_from_glb(meshes.parts_to_glb(again))
    )


def dented() -> trimesh.Trimesh:
    cube = trimesh.creation.box(extents=(0.1, 0.1, 0.1)).subdivide()
    top = np.argmax(cube.vertices @ [0, 0, 1] - np.linalg.norm(cube.vertices[:, :2], axis=1))
    cube.vertices[top, 2] -= 0.01
    return cube


def open_box() -> trimesh.Trimesh:
    cube = box()
    cube.update_faces(np.arange(12) != 5)
    return cube


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (dented(), "not convex"),
        (open_box(), "closed"),
        (
            trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], [[0, 1, 2], [0, 2, 1]], process=False),
            "flat",
        ),
        (trimesh.util.concatenate([box(), box().apply_translation([1, 0, 0])]), "not convex"),
        (box((1e-7, 0.1, 0.1)), "flat"),
        (box((0.1, 0.1, 0.1)).apply_translation([1e6, 0, 0]), "origin"),
    ],
)
def test_bad_parts_are_named(mesh: trimesh.Trimesh, message: str) -> None:
    good = (box().vertices, box().faces)
    with pytest.raises(MeshError, match=message) as caught:
        meshes.check_parts([good, (np.asarray(mesh.vertices), np.asarray(mesh.faces))])
    assert caught.value.field == "parts[1]"


def test_part_files_are_checked() -> None:
    with pytest.raises(MeshError, match="GLB"):
        meshes.parts_from_glb(export(box(), "stl"))
    with pytest.raises(MeshError, match="no geometry"):
        meshes.parts_from_glb(
            edit_glb(meshes.parts_to_glb([(box().vertices, box().faces)]), setter("nodes", [{}]))
        )
    with pytest.raises(MeshError, match="at most"):
        meshes.check_parts([(box().vertices, box().faces)] * (meshes.MAX_PARTS + 1))


def test_a_convex_mesh_is_its_own_part() -> None:
    cone = meshes.load(example("cone").stl(), "model/stl")
    assert meshes.properties(cone).convex
    assert len(meshes.check_parts([(cone.vertices, cone.faces)])) == 1
    assert not meshes.properties(meshes.load(example("mug").stl(), "model/stl")).convex


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_hulls_are_convex_and_pushed_in_vertices_are_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    hull = trimesh.convex.convex_hull(rng.normal(size=(30, 3)) * 0.05)
    assert meshes.properties(meshes.Mesh(hull.vertices, hull.faces)).convex
    vertices = np.array(hull.vertices)
    vertices[0] = hull.center_mass + 0.5 * (vertices[0] - hull.center_mass)
    # Pushing one corner halfway in dents the solid unless its neighbours' hull was that shallow already.
    if trimesh.convex.convex_hull(vertices).volume > 1.01 * trimesh.Trimesh(vertices, hull.faces).volume:
        assert not meshes.properties(meshes.Mesh(vertices, np.asarray(hull.faces))).convex


@settings(max_examples=150, deadline=None)
@given(data=st.binary(max_size=400), media_type=st.sampled_from(meshes.MEDIA_TYPES))
def test_noise_is_a_mesh_error(data: bytes, media_type: str) -> None:
    prefixes = {
        "model/stl": b"solid ",
        "model/obj": b"v ",
        "model/ply": b"ply\n",
        "model/gltf-binary": b"glTF",
    }
    for content in (data, prefixes[media_type] + data):
        with pytest.raises(MeshError):
            meshes.load(content, media_type)


@settings(max_examples=200, deadline=None)
@given(
    media_type=st.sampled_from(sorted(FORMATS)),
    position=st.floats(0, 1, exclude_max=True),
    value=st.integers(0, 255),
    cut=st.booleans(),
)
def test_damaged_files_are_refused_or_read_but_never_crash(
    media_type: str, position: float, value: int, cut: bool
) -> None:
    data = bytearray(export(box(), FORMATS[media_type]))
    at = int(position * len(data))
    data[at] = value
    try:
        mesh = meshes.load(bytes(data[: at + 1] if cut else data), media_type)
    except MeshError:
        return
    assert np.all(np.isfinite(mesh.vertices))
    assert mesh.faces.min() >= 0
    assert mesh.faces.max() < len(mesh.vertices)
