"""A best-grasp question as one asks it elsewhere: by curl, by the SDK, on the command line."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from graspdb.poses import matrices
from graspdb.resources.selection import TrialSelection, best_grasp_request
from graspdb_viewer.view import Placed, View

_DIGITS = 5


class Spoken(NamedTuple):
    """The same question three times; ``command`` ends with a remark where an obstacle is left out."""

    curl: str
    sdk: str
    command: str


def constraints(view: View, selection: TrialSelection, *, solid: bool = True) -> dict[str, Any]:
    """What the view asks, as ``best_grasps`` takes it; ``solid``: the object has a mesh, without which
    nothing is said of an approach.
    """
    given: dict[str, Any] = {**selection, "objective": view.objective}
    pose = view.object_pose
    if pose is None and (view.robot is not None or view.scene is not None):
        pose = Placed(position=(0.0, 0.0, 0.0))
    if pose is not None:
        given["object_pose"] = _placed(pose)
    if view.scene is not None:
        given["scene"] = view.scene
    if view.robot is not None:
        base = view.robot_base or Placed(position=(0.0, 0.0, 0.0))
        given |= {"robot": view.robot, "robot_base_pose": _placed(base), "lift_m": view.lift_m}
        if solid:
            given["pregrasp_distance_m"] = view.pregrasp_distance_m
    if view.box is not None:
        centre, half = np.array(view.box.centre), 0.5 * np.array(view.box.size)
        given["box"] = (_rounded(centre - half), _rounded(centre + half))
    if view.cone is not None:
        turn = matrices(np.zeros(3), view.cone.quaternion_xyzw)
        given["approach"] = _rounded(turn[:3, 2])
        given["approach_cone_deg"] = round(view.cone.half_angle_deg, 2)
    if view.obstacle is not None:
        box = view.obstacle
        given["obstacles"] = {
            "boxes": [
                {
                    "size_m": _rounded(box.size),
                    "position": _rounded(box.position),
                    "quaternion_xyzw": _rounded(box.quaternion_xyzw, 7),
                }
            ]
        }
    return given


def spoken(url: str, object_id: str, count: int, given: Mapping[str, Any], *, keyed: bool) -> Spoken:
    """The question about an object in three languages; ``keyed``: the service wants a key."""
    body = best_grasp_request(count, given).model_dump(mode="json", exclude_unset=True)
    key = ' \\\n  -H "Authorization: Bearer $GRASPDB_API_KEY"' if keyed else ""
    curl = (
        f"curl -s {shlex.quote(f'{url}/objects/{object_id}/best-grasp')}{key} \\\n"
        f"  -H 'Content-Type: application/json' \\\n  -d {shlex.quote(json.dumps(body))}"
    )
    keywords = "".join(f"        {name}={value!r},\n" for name, value in {"count": count, **given}.items())
    sdk = (
        f"from graspdb import Client\n\nwith Client({url!r}) as db:\n"
        f"    best = db.objects.get({object_id!r}).best_grasps(\n{keywords}    )\n"
    )
    return Spoken(curl, sdk, _command(url, object_id, count, given))


def _command(url: str, object_id: str, count: int, given: Mapping[str, Any]) -> str:
    options, left_out = [f"--count={count}"], ""
    for name, value in given.items():
        if name == "box":
            options += [f"--box-min={_listed(value[0])}", f"--box-max={_listed(value[1])}"]
        elif name == "obstacles":
            left_out = "\n# without the obstacle, which the command line has no option for"
        else:
            said = _listed(value) if isinstance(value, list) else value
            options.append(f"--{name.replace('_', '-')}={said}")
    words = ["graspdb", "--url", url, "best-grasp", object_id]
    return " ".join(map(shlex.quote, words)) + "".join(f" \\\n  {shlex.quote(o)}" for o in options) + left_out


def _placed(pose: Placed) -> list[float]:
    return _rounded([*pose.position, *pose.quaternion_xyzw], 7)


def _rounded(values: Any, digits: int = _DIGITS) -> list[float]:
    return [round(float(value), digits) + 0.0 for value in values]


def _listed(values: Any) -> str:
    return ",".join(f"{value:g}" if value == round(value, 5) else repr(value) for value in values)
