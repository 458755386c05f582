"""The viewer without a browser: views in links, shapes, questions in other languages, work off the loop."""

from __future__ import annotations

import contextlib
import io
import json
import shlex
import threading
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspdb import Client
from graspdb.errors import error_for
from graspdb.wire import GripperProfile, Problem
from graspdb.wire.presets.grippers import PRESETS
from graspdb.wire.trials import TrialOut
from graspdb_viewer.latest import Latest
from graspdb_viewer.page import in_words
from graspdb_viewer.panels import words
from graspdb_viewer.panels.spoken import constraints, spoken
from graspdb_viewer.scene import colours, shapes
from graspdb_viewer.serving import serving
from graspdb_viewer.view import Box, Cone, Obstacle, Placed, View

NUMBER = st.floats(-10, 10, allow_nan=False)
POINT = st.tuples(NUMBER, NUMBER, NUMBER)


@given(
    view=st.builds(
        View,
        object=st.one_of(st.none(), st.text(max_size=40)),
        grasps=st.sampled_from(["draws", "successes", "none"]),
        count=st.integers(1, 20_000),
        trials=st.booleans(),
        box=st.one_of(st.none(), st.builds(Box, centre=POINT, size=st.just((0.1, 0.2, 0.3)))),
        camera=st.one_of(st.none(), st.tuples(POINT, POINT)),
    )
)
def test_a_link_opens_the_same_view(view: View) -> None:
    token = view.token()
    assert set(token) <= set("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_")
    assert View.of(token) == view


@given(token=st.one_of(st.text(max_size=300), st.binary(max_size=200).map(lambda b: b.hex())))
def test_what_is_no_view_is_refused_in_words(token: str) -> None:
    with contextlib.suppress(ValueError):
        assert isinstance(View.of(token), View)


def test_a_cut_link_and_a_bomb_are_refused() -> None:
    whole = View(object="mug", count=77).token()
    for token in (whole[:-6], whole + "AAAA", "x" * 10_000):
        with pytest.raises(ValueError, match="can't be read"):
            View.of(token)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_a_drawn_gripper_has_the_measures_of_its_profile(name: str) -> None:
    profile = PRESETS[name].profile
    for opening in (0.0, 0.4 * profile.max_opening_m, profile.max_opening_m):
        left = shapes.finger(profile, 1.0, opening).vertices
        right = shapes.finger(profile, -1.0, opening).vertices
        assert left[:, 1].min() - right[:, 1].max() == pytest.approx(opening)
        assert left[:, 2].min() == pytest.approx(profile.tip_offset_m - profile.finger.length_m)
    assert shapes.finger(profile, 1.0, profile.max_opening_m).vertices[:, 2].max() == pytest.approx(
        profile.tip_offset_m
    )
    palm = shapes.palm(profile).vertices
    assert np.ptp(palm, axis=0) == pytest.approx(profile.palm_size_m)
    assert palm[:, 2].max() == pytest.approx(profile.tip_offset_m - profile.finger.length_m)


def test_all_faces_look_outward(box_gripper: GripperProfile) -> None:
    for shape in (
        shapes.ball(0.1),
        shapes.box((1, 2, 3)),
        shapes.gripper(box_gripper),
        shapes.jaw(box_gripper),
    ):
        corners = shape.vertices[shape.faces]
        # The divergence theorem: what faces outward has a volume above zero.
        assert np.linalg.det(corners).sum() / 6 > 0


@pytest.fixture
def box_gripper() -> GripperProfile:
    """A gripper that is there from the start."""
    return PRESETS["pg70"].profile


def test_unknown_values_are_grey_and_others_rise_from_dark_to_bright() -> None:
    painted = colours.of_values([np.nan, 0.0, 0.5, 1.0], 0.0, 1.0).astype(int)
    assert tuple(painted[0]) == colours.UNKNOWN
    assert painted[1].sum() < painted[2].sum() < painted[3].sum()


def test_of_what_waits_only_the_last_is_run() -> None:
    failed: list[Exception] = []
    latest, ran, busy, go = Latest(failed.append), [], threading.Event(), threading.Event()

    def first() -> None:
        busy.set()
        go.wait(30)
        ran.append(0)

    latest.soon(first)
    assert busy.wait(30)
    done = threading.Event()
    for number in range(1, 50):
        latest.soon(lambda number=number: ran.append(number))  # type: ignore[misc]
    latest.soon(lambda: (ran.append(99), done.set()))  # type: ignore[func-returns-value]
    go.set()
    assert done.wait(30)
    assert ran == [0, 99]
    told = threading.Event()
    latest.soon(lambda: 1 / 0)  # type: ignore[arg-type,return-value]
    latest.soon(told.set)
    assert told.wait(30)
    latest.close()
    assert [type(error) for error in failed] in ([], [ZeroDivisionError])


def test_what_others_wrote_is_no_markup() -> None:
    trial = TrialOut.model_validate(
        {
            "seq": 7, "revision": 3, "batch": "b", "position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1],
            "outcome": "slipped", "width_m": 0.012, "gripper": "panda", "gripper_version": 2,
            "metadata": {"note": "<script>alert(1)</script> | **bold** ![x](http://example.com/x.png)"},
        }
    )  # fmt: skip
    story = words.story(trial)
    assert "panda, version 2" in story
    assert "12.0 mm open" in story
    assert "slipped" in story
    for markup in ("<script", "**bold**", "![x]"):
        assert markup not in story


def test_errors_are_told_with_a_way_out() -> None:
    def problem(status: int) -> Exception:
        return error_for(Problem(type="about:blank", title="No", status=status))

    assert "--api-key" in in_words(problem(401), "http://lab")
    assert "http://lab" in in_words(problem(401), "http://lab")
    with Client("http://127.0.0.1:9", retries=0) as nobody, pytest.raises(Exception) as caught:
        nobody.info()
    assert "graspdb-server serve" in in_words(caught.value, nobody.url)


@pytest.mark.parametrize("placed", [False, True])
def test_a_question_is_the_same_in_three_languages(
    placed: bool, db: Client, fresh_id: str, clusters: Callable[..., Any], run: Callable[..., Any]
) -> None:
    item = db.objects.create(fresh_id)
    item.trials.add(clusters([([0.05, 0, 0.1], [0, 1, 0, 0])], 40), True, gripper="pg70")
    view = View(
        box=Box(centre=(0.05, -0.01, 0.1), size=(0.3, 0.31, 0.32)),
        cone=Cone(quaternion_xyzw=(1.0, 0.0, 0.0, 0.0), half_angle_deg=40),
        object_pose=Placed(position=(-0.01, 0.0, 0.0)) if placed else None,
    )
    given = constraints(view, {})
    told = spoken(db.url, item.id, 2, given, keyed=False)
    expected = item.best_grasps(count=2, **given)
    names: dict[str, Any] = {}
    exec(told.sdk, names)  # noqa: S102 - it is what the page tells a person to run
    assert names["best"].answer == expected.answer
    _, _, address, _, header, _, body = shlex.split(told.curl.replace("\\\n", ""))
    answer = httpx.post(address, content=body, headers=dict([header.split(": ")]))
    assert answer.json()["answer"] == expected.answer
    arguments = shlex.split(told.command.replace("\\\n", ""))[1:]
    code, out, _ = run("--json", *arguments)
    assert code == 0
    assert json.loads(out)["answer"] == expected.answer


def test_a_key_is_never_told_and_an_obstacle_is_said_to_be_left_out() -> None:
    view = View(obstacle=Obstacle(position=(0, 0, 0), size=(0.1, 0.1, 0.1)))
    told = spoken("http://lab", "mug", 1, constraints(view, {}), keyed=True)
    assert "$GRASPDB_API_KEY" in told.curl
    assert "'obstacles'" in told.sdk or "obstacles=" in told.sdk
    assert "without the obstacle" in told.command
    assert io.StringIO(told.command).read().count("--") >= 3


def test_what_is_shown_first_is_said_on_the_command_line(
    run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[View] = []

    def refused(*_: Any, view: View, **__: Any) -> Any:
        shown.append(view)
        raise OSError("no port")

    monkeypatch.setattr("graspdb_viewer.serving.serving", refused)
    place = ("--object-pose", "0.5,0,0.1,0,0,0,1", "--robot-base-pose", "0,0.2,0,0,0,1,0")
    run("view", "mug", "--robot", "arm", "--scene", "bench", *place)
    (view,) = shown
    assert (view.object, view.robot, view.scene) == ("mug", "arm", "bench")
    assert view.object_pose == Placed(position=(0.5, 0.0, 0.1))
    assert view.robot_base == Placed(position=(0.0, 0.2, 0.0), quaternion_xyzw=(0.0, 0.0, 1.0, 0.0))
    asked = constraints(view, {})
    assert asked["robot_base_pose"] == [0.0, 0.2, 0.0, 0.0, 0.0, 1.0, 0.0]
    assert {"lift_m", "pregrasp_distance_m", "scene"} <= asked.keys()
    assert "pregrasp_distance_m" not in constraints(view, {}, solid=False)
    told = spoken("http://lab", "mug", 1, asked, keyed=False)
    for option in ("--robot=arm", "--scene=bench", "--robot-base-pose=0,0.2,0", "--lift-m=0.1"):
        assert option in told.command


def test_only_its_own_pages_are_answered(db: Client) -> None:
    with serving(db, port=0, names=["viewer.lab"]) as server:
        port = server.url.rpartition(":")[2]
        for origin, host, ours in (
            (server.url, f"127.0.0.1:{port}", True),
            (f"http://localhost:{port}", f"localhost:{port}", True),
            ("https://viewer.lab", "viewer.lab", True),
            ("http://evil.example", f"127.0.0.1:{port}", False),
            (f"http://rebound.example:{port}", f"rebound.example:{port}", False),
            (server.url, None, False),
        ):
            assert server._ours(origin, host) is ours, (origin, host)
