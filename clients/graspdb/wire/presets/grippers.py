"""The grippers that every GraspDB has from the start: the one table of them.

Their numbers are from published descriptions and data sheets, which ``source`` names; what rests on neither
is in ``unverified``. Each one's base is the link of the named description that ``source`` begins with.

A finger that turns about a pivot while a parallel link keeps its pad upright moves its tip on a circle. Of
such a jaw the description gives the circle and the height of the tips at either end, the data sheet how far
the jaw opens.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from graspdb.wire.grippers import GripperProfile

#: Openings, from closed on, at which the tips' place on their circle is told: in between it is off by less
#: than 0.1 mm.
_STEPS = 16

_FRICTION = "friction: 0.4 is plastic on plastic; measure your pads'"
_BOXES = "boxes: the linkage behind the fingertips is in the palm's box, which is as wide as the open jaw"
_HALF = "max_speed_m_s: half of what is told of the jaw, where it may be each finger's"
_MASS = "finger_mass_kg: a guess"


@dataclass(frozen=True)
class Preset:
    """A gripper that is there from the start: a name for people, and its profile."""

    name: str
    profile: GripperProfile


def _preset(
    name: str,
    *,
    opening: float,
    finger: tuple[float, float, float],
    tip: float,
    palm: tuple[float, float, float],
    base_to_tool: float,
    across: bool = False,
    flange: tuple[tuple[float, ...], tuple[float, ...]] | None = None,
    joints: Mapping[str, tuple[float, float]] | None = None,
    **facts: Any,
) -> Preset:
    """A preset; ``finger`` is width, thickness and length, ``base_to_tool`` along z. ``across``: the jaw
    closes along the base's x axis. ``flange`` is a position and a quaternion xyzw, ``joints`` values open and
    closed.
    """
    turn = (0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5)) if across else (0.0, 0.0, 0.0, 1.0)
    width, thickness, length = finger
    frames = {} if flange is None else {"flange": {"position": flange[0], "quaternion_xyzw": flange[1]}}
    return Preset(
        name,
        GripperProfile.model_validate(
            {
                "max_opening_m": opening,
                "finger": {"width_m": width, "thickness_m": thickness, "length_m": length},
                "tip_offset_m": tip,
                "palm_size_m": palm,
                "base_to_tool": {"position": (0.0, 0.0, base_to_tool), "quaternion_xyzw": turn},
                "friction": 0.4,
                "frames": frames,
                "joints": {name: {"open": at[0], "closed": at[1]} for name, at in (joints or {}).items()},
                **facts,
            }
        ),
    )


def _on_circle(radius: float, *, opening: float, drop: float, tip: float) -> list[dict[str, float]]:
    """Offsets of tips on a circle at openings from 0 on: wide open they are ``tip`` ahead, and ``drop`` below
    the top of the circle. Metres.
    """
    # Half an opening is how far a tip is sideways on its circle, but for a constant.
    wide = math.acos((radius - drop) / radius)
    shift = opening / 2 - radius * math.sin(wide)
    closed = math.asin(-shift / radius)
    offsets = []
    for step in range(_STEPS):
        angle = closed + (wide - closed) * step / _STEPS
        at, height = 2 * (shift + radius * math.sin(angle)), radius * math.cos(angle) - (radius - drop)
        offsets.append({"opening_m": round(abs(at), 6), "tip_offset_m": round(tip + height, 6)})
    return offsets


PRESETS: dict[str, Preset] = {
    # Data sheet: 50 mm/s, 70 N continuous. The tool frame is the description's hand_tcp; the hand's front
    # face is 66 mm from the base, so a 45 mm finger ends 7.6 mm beyond the tool's origin.
    "panda": _preset(
        "Franka Panda hand",
        opening=0.080,
        finger=(0.020, 0.015, 0.045),
        tip=0.0076,
        palm=(0.063, 0.204, 0.066),
        base_to_tool=0.1034,
        flange=((0.0, 0.0, 0.0), (0.0, 0.0, math.sin(math.pi / 8), math.cos(math.pi / 8))),
        joints={"panda_finger_joint1": (0.04, 0.0), "panda_finger_joint2": (0.04, 0.0)},
        finger_mass_kg=0.015,
        max_speed_m_s=0.05,
        force_n=70.0,
        source="panda_hand (fr3_hand) of frankaemika/franka_description; Franka hand data sheet",
        unverified=[
            _FRICTION,
            "tip_offset_m: the description's finger ends 9.5 mm beyond its hand_tcp, this one 7.6 mm",
        ],
    ),
    # The driver's acceleration limit is 39 mm/s^2. 70 - 23 mm of finger are behind the tool's origin.
    "pg70": _preset(
        "Schunk PG70",
        opening=0.070,
        finger=(0.020, 0.015, 0.070),
        tip=0.023,
        palm=(0.080, 0.112, 0.092),
        base_to_tool=0.140,
        finger_mass_kg=0.1,
        max_speed_m_s=0.06,
        max_acceleration_m_s2=0.039,
        force_n=40.0,
        source="Base of the RobWork project's device files for the PG70, whose fingers these are",
        unverified=[
            _FRICTION,
            "max_opening_m: ipa320/schunk_modular_robotics lets each finger travel 30.1 mm, not 35 mm",
        ],
    ),
    "robotiq-2f-85": _preset(
        "Robotiq 2F-85",
        opening=0.085,
        finger=(0.027, 0.022, 0.057),
        tip=0.0193,
        tip_offsets=_on_circle(0.05715, opening=0.085, drop=0.05715 - 0.04342, tip=0.0193),
        palm=(0.075, 0.153, 0.0923),
        base_to_tool=0.130,
        across=True,
        flange=((0.0, 0.0, -0.011), (0.0, 0.0, 0.0, 1.0)),
        joints={"robotiq_85_left_knuckle_joint": (0.0, 0.8)},
        finger_mass_kg=0.085,
        max_speed_m_s=0.075,
        force_n=235.0,
        source="robotiq_85_base_link of PickNikRobotics/ros2_robotiq_gripper: linkage, meshes, force, speed;"
        " Robotiq's name for the opening; tool at the closing region of NVlabs/GraspGen",
        unverified=[
            _FRICTION,
            _BOXES,
            _HALF,
            "finger.thickness_m: of the last 31 mm; 31 mm at the joint",
            "frames.flange: with Robotiq's coupling for Universal Robots, 11 mm high",
        ],
    ),
    "robotiq-2f-140": _preset(
        "Robotiq 2F-140",
        opening=0.140,
        finger=(0.030, 0.0285, 0.070),
        tip=0.017,
        tip_offsets=_on_circle(0.100, opening=0.140, drop=0.0237, tip=0.017),
        palm=(0.075, 0.212, 0.142),
        base_to_tool=0.195,
        joints={"finger_joint": (0.0, 0.7)},
        finger_mass_kg=0.033,
        max_speed_m_s=0.125,
        force_n=125.0,
        source="robotiq_140_base_link of PickNikRobotics/ros2_robotiq_gripper: linkage, meshes, force, speed;"
        " Robotiq's name for the opening; tool at the closing region of NVlabs/GraspGen",
        unverified=[
            _FRICTION,
            _BOXES,
            _HALF,
            "max_opening_m: with the description's own pads the fingers open to 128.5 mm",
            "tip_offsets: the linkage's, where it opens by its name; with the description's pads tips are up"
            " to 4.5 mm farther back near wide open, at the same opening",
        ],
    ),
    "robotiq-hand-e": _preset(
        "Robotiq Hand-E",
        opening=0.050,
        finger=(0.0211, 0.011, 0.0465),
        tip=0.010,
        palm=(0.075, 0.075, 0.099),
        base_to_tool=0.1355,
        across=True,
        flange=((0.0, 0.0, -0.011), (0.0, 0.0, 0.0, 1.0)),
        joints={
            "robotiq_hande_left_finger_joint": (0.025, 0.0),
            "robotiq_hande_right_finger_joint": (0.025, 0.0),
        },
        finger_mass_kg=0.038,
        max_speed_m_s=0.15,
        force_n=130.0,
        source="robotiq_hande_link of AGH-CEAI/robotiq_hande_description: travel, meshes, mass, force, speed",
        unverified=[
            _FRICTION,
            "force_n: 130 N by the description; 185 N is told as well",
            "frames.flange: with the I/O coupling, 11 mm high",
        ],
    ),
    "onrobot-rg2": _preset(
        "OnRobot RG2",
        opening=0.110,
        finger=(0.0202, 0.024, 0.042),
        tip=0.005,
        tip_offsets=_on_circle(0.055, opening=0.110, drop=0.04362, tip=0.005),
        palm=(0.075, 0.158, 0.148),
        base_to_tool=0.185,
        joints={"finger_joint": (-0.558505, 0.785398)},
        finger_mass_kg=0.05,
        max_speed_m_s=0.06,
        force_n=40.0,
        source="onrobot_rg2_base_link of Osaka-University-Harada-Laboratory/onrobot: linkage, meshes;"
        " its driver: opening and force",
        unverified=[
            _FRICTION,
            _BOXES,
            _MASS,
            "max_speed_m_s: a guess; it depends on the force",
            "max_opening_m: the description's linkage and rubber tips open to 104 mm",
            "tip_offsets: the linkage's, where it opens by its name; with the description's pads tips are up"
            " to 10 mm farther back near wide open, at the same opening",
        ],
    ),
    "onrobot-rg6": _preset(
        "OnRobot RG6",
        opening=0.160,
        finger=(0.025, 0.031, 0.0607),
        tip=0.005,
        tip_offsets=_on_circle(0.080, opening=0.160, drop=0.05564, tip=0.005),
        palm=(0.0755, 0.222, 0.1669),
        base_to_tool=0.2226,
        joints={"finger_joint": (-0.628319, 0.628319)},
        finger_mass_kg=0.1,
        max_speed_m_s=0.08,
        force_n=120.0,
        source="onrobot_rg6_base_link of Osaka-University-Harada-Laboratory/onrobot: linkage, meshes;"
        " its driver: opening and force",
        unverified=[
            _FRICTION,
            _BOXES,
            _MASS,
            "max_speed_m_s: a guess; it depends on the force",
            "max_opening_m: the description's linkage and rubber tips open to 151 mm",
            "tip_offsets: the linkage's, where it opens by its name; with the description's pads tips are up"
            " to 11 mm farther back near wide open, at the same opening",
        ],
    ),
    "wsg-50": _preset(
        "Weiss WSG 50-110",
        opening=0.110,
        finger=(0.020, 0.014, 0.081),
        tip=0.010,
        palm=(0.050, 0.146, 0.0725),
        base_to_tool=0.1435,
        across=True,
        joints={"base_joint_gripper_left": (-0.055, -0.0027), "base_joint_gripper_right": (0.055, 0.0027)},
        finger_mass_kg=0.1,
        max_speed_m_s=0.21,
        max_acceleration_m_s2=2.5,
        force_n=80.0,
        source="base_link of nalt/wsg50-ros-pkg: travel, housing and its force-measuring fingers (WSG-FMF);"
        " stroke by its name (WSG 50-110); force, speed and acceleration second-hand",
        unverified=[
            "force_n: not from a data sheet",
            "max_acceleration_m_s2: not from a data sheet",
            _FRICTION,
            _HALF,
            "max_opening_m: of the guides; fingers with a lip, as the WSG-FMF's of 3 mm, open less",
            "finger: of the last 40 mm, 20 mm wide; 30 mm at the guide. Fingers of your own are other ones",
            "joints: the description's limits leave 5.4 mm between the closed guides",
        ],
    ),
}
"""By id."""
