"""Grippers made of URDFs, and refusals of what is none; every URDF here was written for these tests."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspdb.figures.grippers.explained import render_explained
from graspdb.files.urdf import read_gripper
from graspdb.wire import Finger, GripperProfile
from graspdb.wire.presets.grippers import PRESETS

Run = Callable[..., tuple[int, str, str]]
NO_ROTATION = "0 0 0"


def box(size: str, xyz: str = "0 0 0") -> str:
    return f'<collision><origin xyz="{xyz}"/><geometry><box size="{size}"/></geometry></collision>'


def link(name: str, geometry: str = "") -> str:
    return f'<link name="{name}">{geometry}</link>'


def joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    xyz: str = "0 0 0",
    *,
    rpy: str = NO_ROTATION,
    more: str = "",
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/>{more}</joint>'
    )


def limits(lower: float, upper: float, axis: str, effort: float = 70, velocity: float = 0.05) -> str:
    ends = f'lower="{lower}" upper="{upper}"'
    return f'<axis xyz="{axis}"/><limit {ends} effort="{effort}" velocity="{velocity}"/>'


def pair(*, mimic: bool = True, geometry: tuple[str, str] | None = None, more: str = "") -> str:
    """A hand 60 x 200 x 66 mm with fingers 20 x 15 x 45 mm that open 80 mm along y."""
    fingers = geometry or (
        box("0.02 0.015 0.045", "0 0.0075 0.0225"),
        box("0.02 0.015 0.045", "0 -0.0075 0.0225"),
    )
    follows = '<mimic joint="left_joint"/>' if mimic else ""
    return (
        '<robot name="two fingers">'
        + link("hand", box("0.06 0.2 0.066", "0 0 0.033"))
        + link("left", '<inertial><mass value="0.015"/></inertial>' + fingers[0])
        + link("right", fingers[1])
        + link("hand_tcp")
        + link("hand_flange")
        + joint("tcp", "fixed", "hand", "hand_tcp", "0 0 0.1034")
        + joint("screwed", "fixed", "hand", "hand_flange", "0 0 -0.01")
        + joint("left_joint", "prismatic", "hand", "left", "0 0 0.066", more=limits(0, 0.04, "0 1 0"))
        + joint(
            "right_joint", "prismatic", "hand", "right", "0 0 0.066", more=limits(0, 0.04, "0 -1 0") + follows
        )
        + more
        + "</robot>"
    )


def arcs(length: float = 0.06, lean: float = 0.6) -> str:
    """Cranks that lean outwards turn upright by ``lean``; pads at their ends stay upright, and meet then. The
    jaw closes along the base's x.
    """
    text = '<robot name="arc">' + link("base", box("0.10 0.06 0.05", "0 0 0.025"))
    for side, sign in (("l", 1), ("r", -1)):
        # At 0 the pad's inner face is length * sin(lean) from the middle.
        out, up = sign * length * math.sin(lean), length * math.cos(lean)
        turn = limits(0, lean, f"0 {-sign} 0", velocity=2)
        follow = "" if side == "l" else '<mimic joint="l_crank"/>'
        back = f'<axis xyz="0 {sign} 0"/><limit lower="0" upper="{lean}" effort="1" velocity="1"/>'
        text += link(f"{side}_bar") + link(f"{side}_pad", box("0.01 0.02 0.03", f"{sign * 0.005} 0 0.015"))
        text += joint(f"{side}_crank", "revolute", "base", f"{side}_bar", "0 0 0.05", more=turn + follow)
        text += joint(
            f"{side}_wrist",
            "revolute",
            f"{side}_bar",
            f"{side}_pad",
            f"{out} 0 {up}",
            more=back + '<mimic joint="l_crank"/>',
        )
    return text + "</robot>"


def written(folder: Path, text: str, name: str = "gripper.urdf") -> Path:
    file = folder / name
    file.write_text(text)
    return file


def test_a_pair_of_sliding_fingers(tmp_path: Path) -> None:
    found = read_gripper(written(tmp_path, pair()))
    profile = found.profile
    assert profile.max_opening_m == pytest.approx(0.08)
    assert profile.finger == Finger(width_m=0.02, thickness_m=0.015, length_m=0.045)
    assert profile.tip_offset_m == pytest.approx(0.0076)
    assert profile.tip_offsets == []
    assert profile.palm_size_m == pytest.approx((0.06, 0.2, 0.066))
    assert profile.base_to_tool is not None
    assert profile.base_to_tool.position == pytest.approx((0, 0, 0.1034))
    assert profile.base_to_tool.quaternion_xyzw == pytest.approx((0, 0, 0, 1))
    assert profile.frames["flange"].position == pytest.approx((0, 0, -0.01))
    assert {name: (at.open, at.closed) for name, at in profile.joints.items()} == {
        "left_joint": (0.04, 0.0),
        "right_joint": (0.04, 0.0),
    }
    assert (profile.force_n, profile.max_speed_m_s, profile.finger_mass_kg) == (70, 0.05, 0.015)
    assert found.found["fingers"] == "left and right"
    assert profile.unverified == list(found.assumed)
    assert any(text.startswith("friction") for text in found.assumed)


def test_a_hand_beside_the_bases_axis_is_as_large_as_it_is(tmp_path: Path) -> None:
    mounted = pair().replace(
        '<robot name="two fingers">',
        '<robot name="two fingers"><link name="mount"/>'
        + joint("bracket", "fixed", "mount", "hand", "0.015 -0.04 0.02", rpy="0 0 0.5"),
    )
    profile = read_gripper(written(tmp_path, mounted)).profile
    assert profile.palm_size_m == pytest.approx((0.06, 0.2, 0.066), abs=1e-6)
    assert profile.base_to_tool is not None
    assert profile.base_to_tool.position == pytest.approx((0.015, -0.04, 0.1234))


def test_fingers_without_a_mimic_move_alike_and_meshes_beside_are_read(tmp_path: Path) -> None:
    corners = [(x, y, z) for x in (-10, 10) for y in (0, 15) for z in (0, 45)]
    faces = ["1 2 4", "5 7 8"]
    (tmp_path / "m").mkdir()
    lines = [*(f"v {x} {y} {z}" for x, y, z in corners), *(f"f {face}" for face in faces)]
    (tmp_path / "m/finger.obj").write_text("mtllib /etc/passwd\n" + "\n".join(lines) + "\n")

    def mesh(scale: str) -> str:
        return f'<visual><geometry><mesh filename="m/finger.obj" scale="{scale}"/></geometry></visual>'

    text = pair(mimic=False, geometry=(mesh("0.001 0.001 0.001"), mesh("0.001 -0.001 0.001")))
    found = read_gripper(written(tmp_path, text))
    assert found.profile.max_opening_m == pytest.approx(0.08)
    assert found.profile.finger == Finger(width_m=0.02, thickness_m=0.015, length_m=0.045)
    assert any("move alike" in text for text in found.assumed)


def test_tips_on_arcs_follow_their_circle(tmp_path: Path) -> None:
    length, lean = 0.06, 0.6
    profile = read_gripper(written(tmp_path, arcs(length, lean))).profile
    assert profile.max_opening_m == pytest.approx(2 * length * math.sin(lean), abs=1e-5)
    assert profile.tip_offsets[0].opening_m == pytest.approx(0.0, abs=1e-5)
    for tip in [*profile.tip_offsets]:
        ahead = math.sqrt(length**2 - (tip.opening_m / 2) ** 2) - length * math.cos(lean)
        assert tip.tip_offset_m - profile.tip_offset_m == pytest.approx(ahead, abs=1e-5)
    assert profile.base_to_tool is not None
    # The jaw closes along the base's x: the tool's y.
    closing = profile.in_tool("base").quaternion_xyzw
    assert abs(closing[2]) == pytest.approx(math.sqrt(0.5))
    assert profile.joints["l_crank"].open == 0.0
    assert profile.joints["l_crank"].closed == pytest.approx(lean, abs=1e-3)
    assert profile.joints["r_wrist"].closed == pytest.approx(lean, abs=1e-3)


def three() -> str:
    text = '<robot name="three">' + link("palm", box("0.1 0.1 0.05", "0 0 0.025"))
    for i in range(3):
        angle = 2 * math.pi * i / 3
        at = f"{0.04 * math.cos(angle)} {0.04 * math.sin(angle)} 0.05"
        follow = "" if i == 0 else '<mimic joint="j0"/>'
        text += link(f"f{i}", box("0.01 0.01 0.06", "0 0 0.03"))
        text += joint(
            f"j{i}",
            "revolute",
            "palm",
            f"f{i}",
            at,
            rpy=f"0 0 {angle}",
            more=limits(0, 0.5, "0 1 0") + follow,
        )
    return text + "</robot>"


def suction() -> str:
    return '<robot name="cup">' + link("suction_cup", box("0.02 0.02 0.1")) + "</robot>"


def plunger() -> str:
    text = (
        '<robot name="vacuum gripper">'
        + link("body", box("0.05 0.05 0.1"))
        + link("cup", box("0.02 0.02 0.02"))
    )
    return (
        text
        + joint("spring", "prismatic", "body", "cup", "0 0 0.1", more=limits(0, 0.01, "0 0 1"))
        + "</robot>"
    )


def one_finger() -> str:
    return pair().replace('name="right_joint" type="prismatic"', 'name="right_joint" type="fixed"')


def hand() -> str:
    text = '<robot name="hand">' + link("palm", box("0.1 0.1 0.05"))
    for i in range(5):
        text += link(f"f{i}", box("0.01 0.01 0.06", "0 0 0.03"))
        text += joint(f"j{i}", "revolute", "palm", f"f{i}", f"{0.02 * i} 0 0.05", more=limits(0, 1, "1 0 0"))
    return text + "</robot>"


REFUSED: dict[str, tuple[Callable[[], str], str]] = {
    "suction": (suction, "suction cup"),
    "plunger": (plunger, "suction cup"),
    "three fingers": (three, "more than two fingers"),
    "five fingers": (hand, "5 joints move independently"),
    "one finger": (one_finger, "only one finger moves"),
    "no limits": (lambda: pair().replace('upper="0.04"', 'upper="0"'), "range"),
    "no geometry": (lambda: pair(geometry=("", "")), "geometry"),
    "dtd": (lambda: '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]>' + pair(), "DTD"),
    "not XML": (lambda: "<robot name='x'><link", "no XML"),
    "not a URDF": (lambda: "<sdf/>", "outermost"),
    "xacro": (lambda: pair().replace("0.1034", "${tcp}"), "xacro"),
    "a circle": (
        lambda: pair(
            more=link("a") + link("b") + joint("x", "fixed", "a", "b") + joint("y", "fixed", "b", "a")
        ),
        "tree",
    ),
    "two parents": (lambda: pair(more=joint("again", "fixed", "left", "right")), "tree"),
    "stranger": (lambda: pair(more=joint("x", "fixed", "hand", "nowhere")), "nowhere"),
    "nan": (lambda: pair().replace("0 0 0.066", "0 0 nan"), "finite"),
    "no axis": (lambda: pair().replace('axis xyz="0 1 0"', 'axis xyz="0 0 0"'), "axis"),
    "text for a number": (lambda: pair().replace("0 0 0.066", "a b c"), "can't be read"),
    "many": (lambda: pair(more="".join(link(f"l{i}") for i in range(300))), "200"),
}


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_what_is_no_two_finger_gripper_is_refused_in_words(tmp_path: Path, name: str) -> None:
    make, words = REFUSED[name]
    with pytest.raises(ValueError, match=words):
        read_gripper(written(tmp_path, make()))


@pytest.mark.parametrize(
    "name",
    [
        "package://robot/finger.stl",
        "../outside.stl",
        "link.stl",
        "file:///etc/passwd",
        "/etc/passwd",
        "http://127.0.0.1:9/finger.stl",
    ],
)
def test_no_file_outside_the_urdfs_folder_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    folder = tmp_path / "gripper"
    folder.mkdir()
    (tmp_path / "outside.stl").write_text("solid x\nendsolid x\n")
    os.symlink(tmp_path / "outside.stl", folder / "link.stl")
    mesh = f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
    file = written(folder, pair(geometry=(mesh, mesh)))
    opened: list[str] = []
    read = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda self: (opened.append(str(self)), read(self))[1])
    with pytest.raises(ValueError, match="is not opened"):
        read_gripper(file)
    assert opened == [str(file)]


def test_the_command_shows_what_it_made_and_makes_it(run: Run, fresh_id: str, tmp_path: Path) -> None:
    file = str(written(tmp_path, pair()))
    code, text, _ = run("grippers", "from-urdf", file, "--dry-run")
    assert code == 0
    assert "left and right" in text
    shown = json.loads(text[text.index("{") :])
    assert shown["max_opening_m"] == 0.08
    assert run("grippers", "show", "two-fingers")[0] == 1
    assert run("grippers", "from-urdf", file, "--id", fresh_id)[0] == 0
    made = json.loads(run("grippers", "show", fresh_id)[1])
    assert made == {**shown, "name": "two fingers"}
    again = tmp_path / "again.json"
    again.write_text(run("grippers", "show", fresh_id)[1])
    assert run("grippers", "create", f"{fresh_id}-2", str(again))[0] == 0
    assert json.loads(run("--json", "grippers", "from-urdf", file, "--dry-run")[1])["found"]["palm"] == "hand"
    assert run("grippers", "from-urdf", str(written(tmp_path, suction(), "cup.urdf")))[0] == 1
    drawn = tmp_path / "form.svg"
    assert run("grippers", "explain", str(again), "-o", str(drawn))[0] == 0
    assert "max_opening_m" in drawn.read_text()
    assert run("grippers", "explain", fresh_id, "-o", str(tmp_path / "form.png"))[0] == 0
    assert run("grippers", "explain", "-o", str(tmp_path / "form.pdf"))[0] == 2


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_field_of_a_profile_is_explained(name: str) -> None:
    text = render_explained(PRESETS[name].profile, name, "svg").decode()
    fields: set[str] = {
        field for field in GripperProfile.model_fields if field not in ("finger", "tip_offsets")
    }
    fields |= {f"finger.{field}" for field in Finger.model_fields}
    if PRESETS[name].profile.tip_offsets:
        fields.add("tip_offsets")
    assert {field for field in fields if field not in text} == set()


def test_a_profile_of_few_fields_is_explained(tmp_path: Path) -> None:
    least: dict[str, Any] = {
        "max_opening_m": 0.05,
        "finger": {"width_m": 0.01, "thickness_m": 0.01, "length_m": 0.05},
        "palm_size_m": [0.05, 0.08, 0.05],
    }
    png = render_explained(GripperProfile.model_validate(least), "least", "png")
    assert png.startswith(b"\x89PNG")
    assert np.frombuffer(png[16:24], dtype=">u4").min() > 500
