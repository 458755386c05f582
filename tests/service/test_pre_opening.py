"""Pre-shaping: collisions are tested with the jaw as far open as it will be commanded to be."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from contextvars import copy_context
from typing import Any

import httpx
import numpy as np
import pytest

from graspdb.examples import example
from graspdb.wire.presets.grippers import PRESETS
from graspdb_density import IsotropicKernel
from graspdb_geometry import openings
from graspdb_geometry.collision import Part, Scene, box_part
from graspdb_geometry.features.jaw_pairs import pairs_of_parts
from graspdb_geometry.features.ridges import ridges_of_parts
from graspdb_geometry.poses import ToolPoses
from graspdb_service.problems import ProblemError
from graspdb_service.usecases.densities.prior import density_on
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.runtime.asked import Asked, begin
from graspdb_service.usecases.runtime.compute import Compute
from known_jaws import SHAPES

Poses = tuple[Any, Any]
Make, Post, Clusters = Callable[..., str], Callable[..., Any], Callable[..., Poses]
ABOVE = (1.0, 0.0, 0.0, 0.0)
#: A bar 40 mm wide and walls 25 mm beside it; the Panda's open fingers are 40 to 55 mm aside.
BAR = ((0.02, 0.04, 0.06), (0.0, 0.0, 0.0))
WALLS = tuple(((0.06, 0.02, 0.06), (0.0, side * 0.055, 0.0)) for side in (-1.0, 1.0))
OWN = ("position", "quaternion_xyzw", "density", "relative", "width_m", "collision_free")


def put_boxes(http: httpx.Client, slug: str, boxes: Sequence[tuple[Any, Any]]) -> None:
    triangles = b""
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
    faces += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    for size, centre in boxes:
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        corners = corners * size + centre
        triangles += b"".join(struct.pack("<12fH", 0, 0, 0, *corners[list(f)].ravel(), 0) for f in faces)
    body = b"\0" * 80 + struct.pack("<I", 12 * len(boxes)) + triangles
    answer = http.put(f"/objects/{slug}/mesh", content=body, headers={"Content-Type": "model/stl"})
    assert answer.status_code in (200, 201), answer.text


@pytest.fixture
def slot(
    http: httpx.Client,
    make_object: Callable[..., str],
    post: Callable[..., Any],
    clusters: Callable[..., Poses],
) -> httpx.Client:
    """``thing`` is the bar between walls of its own, grasped from above with a Panda."""
    make_object(http)
    put_boxes(http, "thing", [BAR, *WALLS])
    tried = clusters([((0, 0, 0.025), ABOVE)], 200, seed=1, sigma_m=0.001, sigma_rad=0.01)
    post(http, "thing", tried, gripper="panda")
    return http


def best(http: httpx.Client, **asked: Any) -> dict[str, Any]:
    answer = http.post("/objects/thing/best-grasp", json=asked)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def test_what_collides_wide_open_is_free_pre_shaped(slot: httpx.Client) -> None:
    assert best(slot)["status"] == "infeasible"
    (grasp,) = best(slot, pre_opening_m="auto")["grasps"]
    assert grasp["collision_free"] is True
    assert grasp["opening_m"] == pytest.approx(0.053, abs=0.003)
    assert grasp["width_m"] == pytest.approx(0.04, abs=0.002)
    (same,) = best(slot, pre_opening_m=0.054)["grasps"]
    assert same["opening_m"] == 0.054
    assert same["collision_free"] is True
    assert best(slot, pre_opening_m=0.075)["status"] == "infeasible"
    assert best(slot, pre_opening_m=0.03)["status"] == "infeasible"
    told = slot.get("/objects/thing/best-grasp?pre_opening_m=auto&pregrasp_distance_m=0.1").json()
    assert told["grasps"][0]["opening_m"] == pytest.approx(0.053, abs=0.003)
    assert slot.get("/objects/thing/best-grasp?pre_opening_m=0.054").json()["grasps"][0]["opening_m"] == 0.054


def test_likelihood_is_told_at_the_opening_it_was_tested_at(slot: httpx.Client) -> None:
    poses = {"position": [[0, 0, 0.025], [0, 0, 0.3]], "quaternion_xyzw": [ABOVE, ABOVE]}

    def likely(**asked: Any) -> dict[str, Any]:
        answer = slot.post("/objects/thing/likelihood", json={"poses": poses, **asked})
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    wide, auto, fixed = likely(), likely(pre_opening_m="auto"), likely(pre_opening_m=0.05)
    assert (wide["collision_free"], wide.get("opening_m")) == ([False, True], None)
    assert auto["collision_free"] == fixed["collision_free"] == [True, True]
    # The second closes on nothing: nothing says how far open it should come.
    assert auto["opening_m"] == pytest.approx([0.05, 0.08], abs=0.0011)
    assert fixed["opening_m"] == [0.05, 0.05]
    one = {"position": "0,0,0.025", "quaternion_xyzw": "1,0,0,0", "pre_opening_m": "0.05"}
    assert slot.get("/objects/thing/likelihood", params=one).json()["collision_free"] == [True]


def test_without_it_answers_are_what_they_were(slot: httpx.Client) -> None:
    for asked in ({"collision_free": False}, {"collision_free": False, "count": 3}):
        plain, wide = best(slot, **asked), best(slot, **asked, pre_opening_m=0.08)
        for grasp, other in zip(plain["grasps"], wide["grasps"], strict=True):
            assert {name: grasp[name] for name in OWN} == {name: other[name] for name in OWN}
            assert grasp["opening_m"] == other["opening_m"] == 0.08


def test_a_pre_opening_that_can_not_be_names_the_way_out(
    http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(http)
    post(http, "thing", two_clusters)
    path = "/objects/thing/best-grasp"
    for wrong in (0, -1, "wide", 3, "NaN"):
        refused = http.post(path, json={"pre_opening_m": wrong})
        assert refused.status_code == 422, wrong
        assert {e["field"].partition(".")[0] for e in refused.json()["errors"]} == {"pre_opening_m"}
    refused = http.post(path, json={"pre_opening_m": 0.05})
    assert (refused.status_code, refused.json()["type"].rpartition(":")[2]) == (409, "gripper-unknown")
    refused = http.post(path, json={"pre_opening_m": 0.09, "gripper": "panda"})
    assert (refused.status_code, refused.json()["errors"][0]["field"]) == (422, "pre_opening_m")
    assert "0.08 m" in refused.text
    refused = http.post(path, json={"pre_opening_m": "auto", "gripper": "panda"})
    assert (refused.status_code, refused.json()["type"].rpartition(":")[2]) == (409, "collision-unknown")
    # Without a mesh the opening still counts for obstacles: walls beside the tool, 45 mm aside.
    where = two_clusters[0][0].tolist()
    candidates = {"position": [where], "quaternion_xyzw": [ABOVE]}
    walls = [
        {"size_m": [0.2, 0.02, 0.2], "position": [where[0], where[1] + side * 0.055, where[2] - 0.08]}
        | {"quaternion_xyzw": [0, 0, 0, 1]}
        for side in (-1, 1)
    ]
    asked = {"gripper": "panda", "candidates": candidates, "obstacles": {"boxes": walls}}
    assert best(http, **asked)["status"] == "infeasible"
    (grasp,) = best(http, **asked, pre_opening_m=0.05)["grasps"]
    assert grasp["opening_m"] == 0.05


def test_proposals_are_drawn_where_the_pre_shaped_jaw_is_free(slot: httpx.Client) -> None:
    asked = {"strategy": "edges", "gripper": "panda", "count": 200, "seed": 1}
    narrow = {"sigma_position_m": 0.002, "sigma_rotation_deg": 2}
    wide, auto = (
        slot.post("/objects/thing/proposals", json={**asked, **narrow, **more})
        for more in ({}, {"pre_opening_m": "auto"})
    )
    assert auto.status_code == 200, auto.text
    openings = np.array(auto.json()["opening_m"])
    assert openings.shape == (200,)
    assert ((openings > 0.01) & (openings <= 0.08)).all()
    by_density = slot.post("/objects/thing/proposals", json={"count": 3, "pre_opening_m": 0.05}).json()
    assert by_density["opening_m"] == [0.05] * 3
    across = np.abs(np.array(auto.json()["position"])[:, 1]) < 0.01
    assert across.mean() > 0.05
    if wide.status_code == 200:
        assert (np.abs(np.array(wide.json()["position"])[:, 1]) < 0.01).mean() < across.mean()


def test_tips_on_arcs_must_clear_obstacles_once_they_have_closed(
    http: httpx.Client,
    make_object: Callable[..., str],
    post: Callable[..., Any],
    clusters: Callable[..., Poses],
) -> None:
    """A bar that stands on a table, the open tips 5 mm above that: they come 10 mm closer in closing."""
    make_object(http)
    put_boxes(http, "thing", [((0.02, 0.03, 0.05), (0.0, 0.0, 0.025))])
    profile = PRESETS["robotiq-2f-85"].profile
    straight = profile.model_copy(update={"tip_offsets": [], "source": None, "unverified": []})
    assert (
        http.post("/grippers", json={**straight.model_dump(mode="json"), "id": "straight"}).status_code == 201
    )
    tool = profile.tip_offset_m + 0.005
    tried = clusters([((0, 0, tool), ABOVE)], 50, seed=1, sigma_m=0.0002, sigma_rad=0.002)
    post(http, "thing", tried)
    table = {"size_m": [1, 1, 0.1], "position": [0, 0, -0.05], "quaternion_xyzw": [0, 0, 0, 1]}
    candidates = {"position": [[0, 0, tool]], "quaternion_xyzw": [ABOVE]}
    asked = {"candidates": candidates, "obstacles": {"boxes": [table]}}
    for gripper, status in (("straight", "ok"), ("robotiq-2f-85", "infeasible")):
        assert best(http, gripper=gripper, **asked)["status"] == status, gripper
        (grasp,) = best(http, gripper=gripper, candidates=candidates)["grasps"]
        assert grasp["width_m"] == pytest.approx(0.03, abs=1e-4)


def test_a_sweep_says_what_of_an_arc_is_not_simulated(
    http: httpx.Client, make_object: Callable[..., str]
) -> None:
    make_object(http)
    assert http.patch("/objects/thing", json={"mass_kg": 0.2}).status_code == 200
    put_boxes(http, "thing", [BAR])
    for gripper, told in (("robotiq-2f-85", 1), ("panda", 0)):
        made = http.post(
            "/objects/thing/sweeps", json={"gripper": gripper, "grid": {"max_poses": 100}, "purpose": "check"}
        )
        assert made.status_code == 202, made.text
        assert len(made.json()["warnings"]) == told
    warned = http.get("/sweeps").json()["items"][1]["warnings"]
    assert "arcs" in warned[0]


# -- an object that nobody tried yet


def test_a_mug_has_a_prior_for_tips_on_arcs() -> None:
    """As docs/guide/grippers.md types it: each grasp of the mug at its own opening, before any trial."""
    parts = [(np.asarray(v), np.asarray(f)) for v, f in example("mug").parts]
    solid, shape = Scene(parts), SHAPES["robotiq-2f-85"]
    pairs = pairs_of_parts(parts, ridges_of_parts(parts), opening_m=shape.max_opening_m)
    test = CollisionTest(solid, shape, "auto")
    density = density_on([pairs], test, IsotropicKernel(0.01, 0.25), True, threads=2)
    assert density is not None
    some = density.poses[:: max(1, density.size // 50)]
    for opening, position, quaternion in zip(test.openings(some), *some, strict=True):
        assert opening == pytest.approx(round(opening, 3), abs=1e-9)
        pose = ToolPoses(position[None], quaternion[None])
        assert not solid.collides(pose, shape.at(opening))[0]
        assert openings.widths(solid, pose, shape.at(opening))[0] <= opening


class Telling(Scene):
    """A geometry that does something when it is first asked, and counts how often it is."""

    def __init__(self, parts: Sequence[Part], then: Callable[[], None]) -> None:
        super().__init__(parts)
        self.then, self.asked = then, 0

    def extents(self, *asked: Any) -> Any:
        if not self.asked:
            self.then()
        self.asked += 1
        return super().extents(*asked)


@pytest.mark.parametrize("kind", ["deadline", "client-gone"])
def test_a_prior_that_nobody_waits_for_ends(kind: str) -> None:
    question = Asked("somebody")

    def unwanted() -> None:
        question.gone, question.seconds = kind == "client-gone", 0.0

    parts = [box_part((0.02, 0.02, 0.05), (0, 0, 0), (0, 0, 0, 1))]
    solid = Telling(parts, unwanted)
    test = CollisionTest(solid, SHAPES["robotiq-2f-85"], "auto")
    pairs = pairs_of_parts(parts, ridges_of_parts(parts), opening_m=0.085)
    kernel = IsotropicKernel(0.01, 0.25)

    def make() -> None:
        begin(question)
        Compute(2).run(lambda: density_on([pairs], test, kernel, True, threads=2))

    with pytest.raises(ProblemError) as found:
        copy_context().run(make)
    assert found.value.kind == kind
    assert question.step == "looking at where the jaw fits"
    # Of all poses it saw only the first block's.
    assert 0 < solid.asked < 1_000
