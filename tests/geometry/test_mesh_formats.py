"""Dialects of STL, OBJ, PLY and GLB: each gives the same solid, or is refused with its cause."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspdb_geometry import meshes
from graspdb_geometry.mesh_reading.polygons import triangles_of
from graspdb_geometry.meshes import MeshError, MeshProperties

SIZE = np.array([0.04, 0.06, 0.1])
CORNERS = (np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) - 0.5) * SIZE
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
TRIANGLES = [(a, *pair) for a, b, c, d in SIDES for pair in ((b, c), (c, d))]


def read(data: bytes | str, media_type: str) -> MeshProperties:
    return meshes.inspect(data.encode() if isinstance(data, str) else data, media_type).properties


def check_box(data: bytes | str, media_type: str) -> None:
    found = read(data, media_type)
    assert found.watertight, found.warnings
    assert found.volume_m3 == pytest.approx(SIZE.prod(), rel=1e-4)
    np.testing.assert_allclose(found.upper, SIZE / 2, atol=1e-5)
    expected = SIZE.prod() / 12 * (SIZE @ SIZE - SIZE * SIZE)
    np.testing.assert_allclose(np.diag(np.array(found.inertia)), expected, rtol=1e-3)


def refused(data: bytes | str, media_type: str, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        read(data, media_type)


# --------------------------------------------------------------------------------------------- STL


def facet(corners: np.ndarray[Any, Any]) -> str:
    lines = [f"   vertex {x:.6e} {y:.6e} {z:.6e}" for x, y, z in corners]
    return "\n".join([" facet normal 0 0 0", "  outer loop", *lines, "  endloop", " endfacet"])


FACETS = [facet(CORNERS[list(triangle)]) for triangle in TRIANGLES]
ASCII_STL = "\n".join(["solid part", *FACETS, "endsolid part", ""])


@pytest.mark.parametrize(
    "change",
    [
        str.upper,
        lambda text: text.replace("endsolid", "ENDSOLID"),
        lambda text: text.replace("endsolid", "end solid"),
        lambda text: text.replace("part", "vertex count 8 ok"),
        lambda text: text.replace("part", "facet 1 of vertex 2 3 4"),
        lambda text: text.replace(" part", ""),
        lambda text: text.replace("endfacet", "end facet"),
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: text.replace("\n", " "),
        lambda text: text.replace(".", ","),
        lambda text: text.replace("e-02 ", "e-02, "),
        lambda text: text.replace("e-0", "D-0"),
        lambda text: text.replace("e-0", "E-0"),
        lambda text: "  \n\n" + text + "\n\n\t\n",
        lambda text: text.replace("   vertex", "\tvertex\t"),
        lambda text: text.replace(FACETS[6], "endsolid part\n\nsolid vertex 2\n" + FACETS[6]),
    ],
)
def test_ascii_stl_of_other_tools(change: Callable[[str], str]) -> None:
    assert change(ASCII_STL) != ASCII_STL
    check_box(change(ASCII_STL), "model/stl")


def test_ascii_stl_in_utf_16() -> None:
    check_box(ASCII_STL.encode("utf-16"), "model/stl")


def binary_stl(header: bytes = b"cad", count: int | None = None, attributes: int = 0) -> bytes:
    records = [struct.pack("<12fH", 0, 0, 0, *CORNERS[list(t)].ravel(), attributes) for t in TRIANGLES]
    return (
        header.ljust(80, b"\0")
        + struct.pack("<I", len(records) if count is None else count)
        + b"".join(records)
    )


@pytest.mark.parametrize(
    "data",
    [
        binary_stl(),
        binary_stl(b"solid written by a tool that does not mind"),
        binary_stl(b"COLOR=\x80\x80\x80\xff", attributes=0x8FFF),
        binary_stl(count=0),
        binary_stl() + b"\0" * 92,
        binary_stl() + b"\n",
        binary_stl(b"solid x") + b"created by someone",
    ],
)
def test_binary_stl_of_other_tools(data: bytes) -> None:
    check_box(data, "model/stl")


def test_stl_that_is_cut_off_says_so() -> None:
    refused(binary_stl()[:-1], "model/stl", "cut off: its header declares 12 triangles and it holds 11")
    refused(binary_stl(count=11), "model/stl", "declares 11 triangles, but 12 would fit")
    refused(ASCII_STL[:600], "model/stl", "cut off")
    refused(ASCII_STL.replace("   vertex", "   corner", 1), "model/stl", "three vertices")


# --------------------------------------------------------------------------------------------- OBJ


def obj(faces: list[str], before: str = "") -> str:
    vertices = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in CORNERS]
    return "\n".join([before, *vertices, *faces, ""])


def polygons(form: str = "{}") -> list[str]:
    return ["f " + " ".join(form.format(corner + 1) for corner in side) for side in SIDES]


@pytest.mark.parametrize(
    "text",
    [
        obj(polygons()),
        obj(["f " + " ".join(str(corner - 8) for corner in side) for side in SIDES]),
        obj(polygons("{0}/{0}"), "vt 0 0\nvt 0 1"),
        obj(polygons("{0}//{0}"), "vn 0 0 1"),
        obj(polygons("{0}/{0}/{0}"), "mtllib x.mtl\no box\ng side top\nusemtl red\ns off"),
        obj([face + " # lid" for face in polygons()]),
        obj(polygons(), "\ufeff# made by hand"),
        obj(polygons(), "# from C:\\meshes\\"),
        obj([face.replace(" ", " \\\n", 2) for face in polygons()]),
        obj(polygons()).replace("\n", "\r"),
        obj(polygons()).replace("\n", "\r\n"),
        obj([face.replace("f ", "fo ") for face in polygons()]),
        obj([face.replace("f ", "F ") for face in polygons()]).replace("v ", "V "),
        obj(polygons()).replace("0000 ", "0000\t"),
        "\n".join(line + " 1.0" if line.startswith("v ") else line for line in obj(polygons()).split("\n")),
        "\n".join(
            line + " .5 .5 1" if line.startswith("v ") else line for line in obj(polygons()).split("\n")
        ),
        obj([*polygons(), "l 1 2", "p 3"]),
        obj(polygons()).replace(".", ","),
        "\n".join(
            f"{obj([face])}" for face in [f"f {a - 8} {b - 8} {c - 8} {d - 8}" for a, b, c, d in SIDES]
        ),
    ],
)
def test_obj_of_other_tools(text: str) -> None:
    check_box(text, "model/obj")


def test_obj_in_utf_16() -> None:
    check_box(obj(polygons()).encode("utf-16"), "model/obj")


def test_obj_without_faces_says_what_it_is() -> None:
    refused(obj([]), "model/obj", "cloud of points")
    refused(obj(["curv 0 1 1 2 3"]), "model/obj", "curves or surfaces")
    refused(obj(["f 1 2 3 x"]), "model/obj", "line 10")
    refused(obj(["f 1 2 99"]), "model/obj", "does not exist")
    refused(obj(["f 1 2 -99"]), "model/obj", "does not exist")


# ---------------------------------------------------------------------------------------- polygons


def prism(outline: list[tuple[float, float]], height: float = 0.08) -> str:
    """A prism as OBJ whose lids are one polygon each."""
    count = len(outline)
    vertices = [f"v {x} {y} {z}" for z in (0.0, height) for x, y in outline]
    lids = [
        "f " + " ".join(map(str, range(count, 0, -1))),
        "f " + " ".join(map(str, range(count + 1, 2 * count + 1))),
    ]
    sides = [
        f"f {k + 1} {(k + 1) % count + 1} {(k + 1) % count + 1 + count} {k + 1 + count}" for k in range(count)
    ]
    return "\n".join([*vertices, *lids, *sides, ""])


CHANNEL = [(0, 0), (0.06, 0), (0.06, 0.06), (0.04, 0.06), (0.04, 0.02), (0.02, 0.02), (0.02, 0.06), (0, 0.06)]


@pytest.mark.parametrize("shift", range(8))
def test_a_concave_polygon_covers_what_it_encloses(shift: int) -> None:
    outline = CHANNEL[shift:] + CHANNEL[:shift]
    found = read(prism([(float(x), float(y)) for x, y in outline]), "model/obj")
    assert found.watertight
    assert found.volume_m3 == pytest.approx((0.06 * 0.06 - 0.02 * 0.04) * 0.08, rel=1e-6)
    assert found.area_m2 == pytest.approx(2 * 0.0028 + (0.24 + 0.08) * 0.08, rel=1e-6)


def test_a_dart_of_four_corners_is_split_through_its_dent() -> None:
    for shift in range(4):
        dart = [(0.0, 0.0), (0.06, 0.02), (0.02, 0.02), (0.02, 0.06)]
        found = read(prism(dart[shift:] + dart[:shift]), "model/obj")
        assert found.volume_m3 == pytest.approx(0.5 * (2 * 0.06 * 0.02 - 2 * 0.02 * 0.02) * 0.08, rel=1e-6)
        assert found.area_m2 is not None


def test_a_polygon_with_a_bridge_to_its_hole() -> None:
    outer = [(0.0, 0.0), (0.06, 0.0), (0.06, 0.06), (0.0, 0.06)]
    inner = [(0.02, 0.02), (0.02, 0.04), (0.04, 0.04), (0.04, 0.02)]
    ring = [*outer, outer[0], *inner, inner[0]]
    vertices = np.array([(x, y, 0.0) for x, y in ring])
    triangles = triangles_of(vertices, range(len(ring)), np.array([len(ring)]))
    corners = vertices[triangles][:, :, :2]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = 0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    assert np.all(areas >= 0)
    assert areas.sum() == pytest.approx(0.06**2 - 0.02**2)


def test_a_polygon_that_crosses_itself_is_refused() -> None:
    refused(prism([(0.0, 0.0), (0.06, 0.06), (0.06, 0.0), (0.0, 0.05)]), "model/obj", "crosses itself")


@settings(max_examples=60, deadline=None)
@given(radii=st.lists(st.floats(0.2, 1.0), min_size=4, max_size=40), tilt=st.floats(-1.5, 1.5))
def test_any_star_is_covered_once(radii: list[float], tilt: float) -> None:
    count = len(radii)
    angle = np.arange(count) * 2 * np.pi / count
    flat = np.stack([radii * np.cos(angle), radii * np.sin(angle)], axis=1)
    points = np.stack([flat[:, 0], flat[:, 1] * np.cos(tilt), flat[:, 1] * np.sin(tilt)], axis=1)
    triangles = triangles_of(points, np.arange(count), np.array([count]))
    assert len(triangles) == count - 2
    vectors = 0.5 * np.cross(
        points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]]
    )
    following = np.roll(flat, -1, axis=0)
    enclosed = 0.5 * float(np.sum(flat[:, 0] * following[:, 1] - flat[:, 1] * following[:, 0]))
    assert np.linalg.norm(vectors, axis=1).sum() == pytest.approx(enclosed, rel=1e-6)


# --------------------------------------------------------------------------------------------- PLY


def ply_header(order: str, faces: str, extra: str = "", vertex: str = "", count: int = 6) -> str:
    properties = vertex or "property float x\nproperty float y\nproperty float z\n"
    head = f"ply\nformat {order} 1.0\ncomment own\n{extra}element vertex 8\n{properties}"
    return f"{head}element face {count}\n{faces}end_header\n"


LIST = "property list uchar int vertex_indices\n"


def ascii_ply(header: str, prefix: str = "", suffix: str = "", between: str = "") -> str:
    vertices = "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in CORNERS)
    sides = "".join(f"{prefix}4 {' '.join(map(str, side))}{suffix}\n" for side in SIDES)
    return header + between + vertices + sides


def binary_ply(
    order: str, count: str = "B", index: str = "i", position: str = "f", lists: list[Any] | None = None
) -> bytes:
    mark = "<" if order == "binary_little_endian" else ">"
    names = {
        "B": "uchar",
        "H": "ushort",
        "i": "int",
        "I": "uint",
        "h": "short",
        "f": "float",
        "d": "double",
        "b": "char",
    }
    vertex = "".join(f"property {names[position]} {axis}\n" for axis in "xyz")
    sides = SIDES if lists is None else lists
    header = ply_header(
        order, f"property list {names[count]} {names[index]} vertex_index\n", vertex=vertex, count=len(sides)
    )
    body = b"".join(struct.pack(f"{mark}3{position}", *corner) for corner in CORNERS)
    body += b"".join(struct.pack(f"{mark}{count}{len(side)}{index}", len(side), *side) for side in sides)
    return header.encode() + body


MIXED = [SIDES[0], *TRIANGLES[2:6], *SIDES[3:]]


@pytest.mark.parametrize(
    "data",
    [
        ascii_ply(ply_header("ascii", LIST)),
        ascii_ply(ply_header("ascii", LIST)).replace("\n", "\r\n"),
        ascii_ply(ply_header("ascii", LIST)).replace("\n", "\r"),
        ascii_ply(ply_header("ascii", "property list uint8 int32 vertex_index\n")),
        ascii_ply(ply_header("ascii", "property uchar red\n" + LIST), prefix="255 "),
        ascii_ply(ply_header("ascii", LIST + "property list uchar float texcoord\n"), suffix=" 2 0.5 0.5"),
        ascii_ply(ply_header("ascii", LIST, "element camera 1\nproperty float view\n"), between="0.5\n"),
        ascii_ply(ply_header("ascii", LIST, "obj_info num_cols 4\n")),
        *[binary_ply(order) for order in ("binary_little_endian", "binary_big_endian")],
        binary_ply("binary_big_endian", "i", "I", "d"),
        binary_ply("binary_little_endian", "H", "h", "d"),
        binary_ply("binary_little_endian", "b", "B"),
        binary_ply("binary_big_endian", lists=MIXED),
        binary_ply("binary_little_endian", lists=MIXED),
    ],
)
def test_ply_of_other_tools(data: bytes | str) -> None:
    check_box(data, "model/ply")


def test_ply_whose_first_number_begins_with_a_line_feed() -> None:
    data = binary_ply("binary_little_endian")
    assert struct.pack("<f", -0.02)[0] == ord("\n")
    assert b"end_header\n\n" in data
    check_box(data, "model/ply")
    check_box(data.replace(b"\n", b"\r", data[: data.index(b"end_header") + 11].count(b"\n")), "model/ply")


def test_ply_with_triangle_strips() -> None:
    strip = [0, 1, 2, 3, 6, 7, 4, 5, 0, 1]
    lids = [-1, 0, 2, 4, 6, -1, 1, 5, 3, 7]
    header = ply_header("ascii", "").replace(
        "element face 6", "element tristrips 1\nproperty list int int vertex_indices"
    )
    vertices = "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in CORNERS)
    values = strip + lids
    check_box(f"{header}{vertices}{len(values)} {' '.join(map(str, values))}\n", "model/ply")


def test_ply_that_can_not_be_read_says_why() -> None:
    cloud = ply_header("ascii", "").replace("element face 6\n", "")
    refused(cloud + "0 0 0\n" * 8, "model/ply", "cloud of points")
    refused(binary_ply("binary_little_endian")[:-3], "model/ply", "cut off")
    refused(ascii_ply(ply_header("ascii", LIST))[:-9], "model/ply", "cut off")
    refused(ascii_ply(ply_header("ascii", LIST)).replace("-0.02", "x", 1), "model/ply", "not a number")
    refused(ascii_ply(ply_header("zip", LIST)), "model/ply", "format")
    refused(
        ascii_ply(ply_header("ascii", "property list uchar quaternion vertex_indices\n")),
        "model/ply",
        "header",
    )
    refused(
        ascii_ply(ply_header("ascii", "property list uchar int corners\n")), "model/ply", "vertex_indices"
    )
    refused(ascii_ply(ply_header("ascii", LIST)).replace("4 0 1", "4 0 9", 1), "model/ply", "does not exist")


# --------------------------------------------------------------------------------------------- GLB


class GlbWriter:
    """A GLB put together by hand."""

    def __init__(self) -> None:
        self.binary = b""
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}],
            "accessors": [],
            "bufferViews": [],
        }

    def view(self, array: np.ndarray[Any, Any]) -> int:
        self.document["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.binary), "byteLength": array.nbytes}
        )
        self.binary += array.tobytes() + b"\0" * (-array.nbytes % 4)
        return len(self.document["bufferViews"]) - 1

    def accessor(self, array: np.ndarray[Any, Any], **more: Any) -> int:
        component = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}[
            array.dtype.str[1:]
        ]
        kind = "SCALAR" if array.ndim == 1 else "VEC3"
        entry = {
            "bufferView": self.view(array),
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        self.document["accessors"].append(entry | more)
        return len(self.document["accessors"]) - 1

    def primitive(self, positions: int, indices: np.ndarray[Any, Any] | None, **more: Any) -> GlbWriter:
        entry: dict[str, Any] = {"attributes": {"POSITION": positions}} | more
        if indices is not None:
            entry["indices"] = self.accessor(indices)
        self.document["meshes"][0]["primitives"].append(entry)
        return self

    def data(self) -> bytes:
        self.document.setdefault("buffers", [{"byteLength": len(self.binary)}])
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(self.binary), 0x004E4942) + self.binary
        return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


POSITIONS = CORNERS.astype("<f4")
INDICES = np.array(TRIANGLES, dtype="<u2").ravel()
STRIP = np.array([0, 1, 2, 3, 6, 7, 4, 5, 0, 1], dtype="<u1")


def glb(**more: Any) -> GlbWriter:
    made = GlbWriter()
    made.document |= more
    return made.primitive(made.accessor(POSITIONS), INDICES)


def glb_of_strips() -> GlbWriter:
    made = GlbWriter()
    positions = made.accessor(POSITIONS)
    made.primitive(positions, STRIP, mode=5)
    made.primitive(positions, np.array([0, 2, 6, 4], dtype="<u2"), mode=6)
    return made.primitive(positions, np.array([1, 5, 7, 3], dtype="<u4"), mode=6)


def glb_without_indices() -> GlbWriter:
    made = GlbWriter()
    return made.primitive(made.accessor(POSITIONS[INDICES.astype(int)]), None)


def glb_of_normalized(kind: str) -> GlbWriter:
    made = GlbWriter()
    top = np.iinfo(kind).max
    signed = kind.startswith("<i")
    values = np.round(CORNERS / 0.05 * top) if signed else np.round((CORNERS / 0.1 + 0.5) * top)
    made.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    made.document["nodes"] = [
        {
            "mesh": 0,
            "scale": [0.05] * 3 if signed else [0.1] * 3,
            "translation": [0.0 if signed else -0.05] * 3,
        }
    ]
    return made.primitive(made.accessor(values.astype(kind), normalized=True), INDICES)


def glb_quantized() -> GlbWriter:
    made = GlbWriter()
    made.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    made.document["nodes"] = [{"mesh": 0, "scale": [0.001] * 3}]
    return made.primitive(made.accessor(np.round(CORNERS * 1000).astype("<i2")), INDICES)


def glb_sparse(*, base: bool) -> GlbWriter:
    made = GlbWriter()
    wrong = POSITIONS.copy() if base else np.zeros_like(POSITIONS)
    rows = np.array([1, 6] if base else range(8), dtype="<u1")
    wrong[rows] = 0
    number = made.accessor(wrong)
    accessor = made.document["accessors"][number]
    if not base:
        del accessor["bufferView"]
    accessor["sparse"] = {
        "count": len(rows),
        "indices": {"bufferView": made.view(rows), "componentType": 5121},
        "values": {"bufferView": made.view(POSITIONS[rows])},
    }
    return made.primitive(number, INDICES)


def glb_interleaved() -> GlbWriter:
    made = GlbWriter()
    number = made.accessor(POSITIONS)
    made.document["bufferViews"][0] = {
        "buffer": 0,
        "byteOffset": len(made.binary),
        "byteLength": 8 * 20,
        "byteStride": 20,
    }
    made.binary += np.concatenate([POSITIONS, np.ones((8, 2), dtype="<f4")], axis=1).tobytes()
    return made.primitive(number, INDICES)


def glb_with_lines() -> GlbWriter:
    made = glb()
    return made.primitive(0, np.array([0, 1], dtype="<u2"), mode=1).primitive(0, None, mode=0)


def glb_in_pieces() -> GlbWriter:
    """Two meshes, shown through nodes that turn, mirror and move them: the halves of the box."""
    made = GlbWriter()
    half = (POSITIONS * [0.5, 1, 1] + [0.01, 0, 0]).astype("<f4")
    made.primitive(made.accessor(half), INDICES)
    made.document["nodes"] = [
        {"children": [1, 2], "translation": [0, 0, 1]},
        {"mesh": 0, "translation": [0, 0, -1]},
        {"mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, -1, 1]},
    ]
    return made


def glb_of_a_data_uri() -> GlbWriter:
    made = glb()
    made.document["buffers"] = [
        {
            "byteLength": len(made.binary),
            "uri": "data:application/octet-stream;base64," + base64.b64encode(made.binary).decode(),
        }
    ]
    made.binary = b""
    return made


GLBS = {
    "plain": glb(),
    "required webp": glb(extensionsRequired=["EXT_texture_webp"]),
    "required texture transform": glb(extensionsRequired=["KHR_texture_transform", "KHR_materials_unlit"]),
    "image as data": glb(images=[{"uri": "data:image/png;base64,iVBORw0KGgo="}]),
    "image beside": glb(images=[{"uri": "wood.png"}]),
    "lines and points": glb_with_lines(),
    "strips and fans": glb_of_strips(),
    "without indices": glb_without_indices(),
    "normalized bytes": glb_of_normalized("<i1"),
    "normalized shorts": glb_of_normalized("<u2"),
    "quantized": glb_quantized(),
    "sparse": glb_sparse(base=True),
    "sparse of nothing": glb_sparse(base=False),
    "interleaved": glb_interleaved(),
    "in pieces": glb_in_pieces(),
    "data uri": glb_of_a_data_uri(),
}


@pytest.mark.parametrize("name", GLBS)
def test_glb_of_other_tools(name: str) -> None:
    found = read(GLBS[name].data(), "model/gltf-binary")
    assert found.watertight, found.warnings
    rough = 2e-2 if name == "normalized bytes" else 1e-3
    assert found.volume_m3 == pytest.approx(SIZE.prod(), rel=rough)
    np.testing.assert_allclose(found.upper, SIZE / 2, atol=rough * 0.05)


def test_bytes_behind_a_glb_are_left_aside() -> None:
    check_box(glb().data() + b"\0\0\0\0", "model/gltf-binary")


def test_glb_that_can_not_be_read_says_why() -> None:
    kind = "model/gltf-binary"
    refused(
        glb(extensionsRequired=["KHR_draco_mesh_compression"]).data(), kind, "KHR_draco.*without compression"
    )
    refused(glb(extensionsRequired=["ACME_secret"]).data(), kind, "ACME_secret")
    refused(
        glb(nodes=[{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}]).data(), kind, "gpu_instancing"
    )
    refused(glb(buffers=[{"byteLength": 168, "uri": "box.bin"}]).data(), kind, "outside")
    refused(json.dumps(glb().document), kind, "glTF as text")
    refused(glb().data()[:-4], kind, "cut off")
    compressed = glb()
    del compressed.document["accessors"][0]["bufferView"]
    compressed.document["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {}}
    refused(compressed.data(), kind, "compressed by KHR_draco")
