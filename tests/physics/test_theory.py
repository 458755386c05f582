"""What the worker says of grasps that mechanics knows: held below 80 % of the limit, not above 125 %."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import bench
import closed_forms
import numpy as np
import pytest
from closed_forms import Case

from graspdb.wire.sweeps import SHAKEN, Engine
from graspdb_simworker.simulation import chunks, lifting
from graspdb_simworker.simulation.bodies import mass_properties
from graspdb_simworker.simulation.grasp_world import GraspWorld
from graspdb_simworker.simulation.labels import Outcome, label_of

CORNERS = (0.4, 0.8, 1.25, 2.5)


def judge(found: bench.Row | None) -> None:
    assert found is not None, "theory does not speak of this grasp"
    assert not found.wrong
    assert found.flips == 1


_SOME = (
    (closed_forms.box((0.06, 0.02, 0.02)), 0.1),
    (closed_forms.box((0.12, 0.004, 0.08), 0.0, 0.01), 0.4),
    (closed_forms.cylinder_by_its_ends(0.02, 0.03, 0.005), 0.2),
    (closed_forms.cylinder_by_its_side(0.025, 0.05, "x", 0.01), 0.1),
    (closed_forms.sphere(0.02), 0.4),
)
# Of these a jaw that shakes them lifts a patch's edge: theory is silent.
_NOT_SHAKEN = (
    (closed_forms.box((0.1, 0.02, 0.03), 0.02, 0.0), 0.4),
    (closed_forms.cylinder_by_its_side(0.015, 0.08, "z"), 0.7),
)


@pytest.mark.parametrize(
    ("protocol", "case", "friction"),
    [
        *((protocol, *some) for protocol in ("wrench", "lift") for some in (*_SOME, *_NOT_SHAKEN)),
        *(("shake", *some) for some in _SOME),
    ],
    ids=lambda value: value.name if isinstance(value, Case) else str(value),
)
def test_labels_flip_at_the_limit(case: Case, friction: float, protocol: str) -> None:
    judge(bench.row(case.rubbing(friction), protocol, "standard", CORNERS))


def test_a_round_grip_of_many_small_areas_holds_at_the_fine_step() -> None:
    """The thinnest of the cylinders, whose strips of contact are cut the finest, and the plainest."""
    case = closed_forms.cylinder_by_its_side(0.008, 0.07, "z").rubbing(0.4)
    judge(bench.row(case, "lift", "fine", (0.8, 1.25)))


@pytest.mark.parametrize(
    ("case", "friction"),
    [
        (closed_forms.box((0.1, 0.02, 0.03), 0.02, 0.0), 0.2),
        (closed_forms.cylinder_by_its_side(0.025, 0.05, "x", 0.01), 0.4),
        (closed_forms.sphere(0.02), 1.0),
    ],
    ids=lambda value: value.name if isinstance(value, Case) else str(value),
)
def test_labels_flip_at_the_limit_in_mujoco_too(case: Case, friction: float) -> None:
    judge(bench.row(case.rubbing(friction), "wrench", "standard", CORNERS, "mujoco"))


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
def test_a_centre_of_mass_off_the_fingers_is_as_fingers_off_the_centre(engine: Engine) -> None:
    """A bar held in its middle, whose centre of mass is drawn 2 cm beside it, has the limit of a uniform one
    held there."""
    size, off = (0.2, 0.03, 0.04), 0.02
    beside = closed_forms.box(size, off).rubbing(0.4)
    limit = bench.asked(beside, "lift")
    assert limit is not None
    assert limit < 0.7 * closed_forms.carried_limit(closed_forms.box(size), lifting.LIFT)
    labels = []
    for load in CORNERS:
        mass = load * limit
        world = GraspWorld(
            [beside.part],
            mass_properties([beside.part], mass).displaced((-off, 0.0, 0.0)),
            beside.friction,
            chunks.gripper_of(closed_forms.PG70, mass),
            engine=engine,
            motion=lifting.LIFT,
        )
        labels.append(label_of(world.close((0.0, 0.0, 0.0), closed_forms.DOWN), lifting.LIFT))
        world.close_world()
    judge(bench.Row(beside, "lift", limit, CORNERS, tuple(labels)))


@pytest.mark.parametrize("protocol", ["wrench", "lift", "shake"])
@pytest.mark.parametrize("friction", [0.2, 0.7])
def test_a_wedge_is_held_up_to_the_angle_of_friction(friction: float, protocol: str) -> None:
    assert bench.wedge_label(friction, 0.8, protocol, "standard").outcome is Outcome.SUCCESS
    assert bench.wedge_label(friction, 1.25, protocol, "standard").outcome is not Outcome.SUCCESS


@pytest.mark.parametrize(
    ("engine", "held"),
    # Bullet's fingers act as if their edges were rounded: see docs/experiments.md.
    [("pybullet", 0.6), ("mujoco", 0.8)],
)
@pytest.mark.parametrize("friction", [0.2, 0.7])
def test_fingertips_hold_a_cylinder_up_to_the_angle_of_friction(
    friction: float, engine: str, held: float
) -> None:
    assert bench.tips_label(friction, held, 0.02, engine).outcome is Outcome.SUCCESS
    assert bench.tips_label(friction, 1.25, 0.02, engine).outcome is not Outcome.SUCCESS


def test_what_slides_while_it_is_shaken_slides_as_far_as_friction_says() -> None:
    """At 1.25 times what two fingers hold, at either step, and then so much that it leaves them. A box that
    lies flat is closed on once more at the fine step: the motion is the same."""
    case, friction = closed_forms.box((0.06, 0.02, 0.02)), 0.4
    limit = 2.0 * friction * closed_forms.PG70.force_n / SHAKEN[0]
    x, z = (closed_forms.slid(1.25 * limit, friction, lifting.SHAKE, axis) for axis in (0, 2))
    farthest = np.hypot(x, z).max()
    assert 0.005 < farthest < 0.030
    for fidelity in ("standard", "fine"):
        label = closed_forms.simulate(
            case.part, case.position, 1.25 * limit, friction, protocol="shake", fidelity=fidelity
        )
        assert label.outcome is Outcome.SUCCESS
        assert (1.0 - label.quality) * lifting.SHAKE.allowed.translation_m == pytest.approx(
            farthest, rel=0.05
        )
    lost = closed_forms.simulate(case.part, case.position, 10.0 * limit, friction, protocol="shake")
    assert np.abs(closed_forms.slid(10.0 * limit, friction, lifting.SHAKE, 0)).max() > 0.04
    assert lost.outcome is Outcome.DROPPED


def test_fingers_do_not_pass_through_what_lies_flat_against_them() -> None:
    """Bullet's contacts of single points rock such a box from corner to corner."""
    case = closed_forms.box((0.06, 0.02, 0.03))
    for mass in (0.1, 1.0):
        label = closed_forms.simulate(case.part, (0.01, 0.0, 0.0), mass, 0.4)
        assert label.outcome is Outcome.SUCCESS
        assert label.width_m == pytest.approx(0.02, abs=2e-4)


def test_the_limit_surface_of_a_patch_has_its_textbook_ends() -> None:
    # Forces alone: friction times the two normal forces. A torque alone: that times the mean distance from
    # the middle, of a square of side a 0.3826 a.
    case = closed_forms.box((0.02, 0.02, 0.02))
    force = 2.0 * 0.4 * 40.0
    loads = np.array(
        [[force, 0, 0, 0, 0, 0], [0, 0, -force, 0, 0, 0], [0, 0, 0, 0, force * 0.3826 * 0.02, 0]]
    )
    assert closed_forms.slip_ratio(case, loads) == pytest.approx(np.ones(3), rel=5e-3)
    # Of a line, a quarter of its length.
    line = closed_forms.cylinder_by_its_side(0.015, 0.08, "x")
    torque = np.array([[0, 0, 0, 0, force * 0.02 / 4.0, 0]])
    assert closed_forms.slip_ratio(line, torque) == pytest.approx([1.0], rel=5e-3)
    # Proportional to the load, and a ball rolls about neither axis before friction at its arm gives way.
    assert closed_forms.slip_ratio(case, 0.5 * loads) == pytest.approx(np.full(3, 0.5), rel=5e-3)
    ball = closed_forms.sphere(0.02)
    assert closed_forms.slip_ratio(ball, np.array([[0, 0, 0, force * 0.02, 0, 0]])) == pytest.approx([1.0])


# -- all of it ---------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("fidelity", ["standard", "fine"])
@pytest.mark.parametrize("protocol", ["wrench", "lift", "shake"])
@pytest.mark.parametrize("friction", bench.FRICTIONS)
@pytest.mark.parametrize("cases", [bench.boxes, bench.cylinders, bench.balls])
def test_no_label_is_wrong(
    cases: Callable[[], Iterator[Case]], friction: float, protocol: str, fidelity: str
) -> None:
    rows = [bench.row(case.rubbing(friction), protocol, fidelity) for case in cases()]
    spoken_of = [row for row in rows if row is not None]
    assert spoken_of or friction > 0.5
    assert [wrong for row in spoken_of for wrong in row.wrong] == []
    assert [row.case.name for row in spoken_of if row.flips != 1] == []


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("fidelity", ["standard", "fine"])
@pytest.mark.parametrize("protocol", ["wrench", "lift", "shake"])
@pytest.mark.parametrize("friction", bench.FRICTIONS)
def test_wedges_by_angle(friction: float, protocol: str, fidelity: str) -> None:
    for share in (0.4, 0.8, 1.25, 1.5):
        held = bench.wedge_label(friction, share, protocol, fidelity).outcome is Outcome.SUCCESS
        assert held == (share < 1.0), (share, math.degrees(share * math.atan(friction)))
