"""Asking the service for a picture, and showing one in a notebook."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any, TypedDict

from graspdb import wire
from graspdb.errors import GraspDBError
from graspdb.poses import as_poses, pose_frame, pose_trials
from graspdb.resources.pages import segment, validate
from graspdb.transport import Transport

_IN_NOTEBOOKS: dict[str, Any] = {"width": 320, "height": 240, "timeout_s": 10.0}


class PictureOptions(TypedDict, total=False):
    """What a picture shows, and from where.

    - ``width``, ``height``: pixels, by default 480 and 360; at most 1,280 and 960.
    - ``azimuth_deg``, ``elevation_deg``: from where it is seen, about the object's z from its x, and above
      its x-y plane; by default from where the fingers are seen best.
    - ``opening_m``: how far open the jaw is; by default closed on the object.
    - ``gripper``, ``protocol``, ``frame``, ``convention``: of the grasp, where it does not say so itself.
    - ``timeout_s``: within this time, or DeadlineExceeded.
    """

    width: int
    height: int
    azimuth_deg: float | None
    elevation_deg: float | None
    opening_m: float | None
    gripper: str | None
    protocol: str | None
    frame: str | None
    convention: str | None
    timeout_s: float | None


def picture(
    transport: Transport, object: str, grasp: Any = None, *, retries: int | None = None, **options: Any
) -> bytes:
    """A picture (PNG) of an object by its id, and of the gripper at a grasp of it."""
    fields = {name: value for name, value in options.items() if value is not None}
    if grasp is not None:
        poses = as_poses(grasp)
        if len(poses.position) != 1:
            raise ValueError(f"a picture shows one grasp; these are {len(poses.position)}")
        fields |= pose_frame(grasp, fields.get("frame"), fields.get("convention"))
        fields |= pose_trials(grasp, fields)
        fields |= {
            "position": poses.position[0].tolist(),
            "quaternion_xyzw": poses.quaternion_xyzw[0].tolist(),
        }
    validate(wire.PictureQuery, fields)
    params = {
        name: ",".join(map(repr, value)) if isinstance(value, list) else value
        for name, value in fields.items()
    }
    path = f"/objects/{segment(object)}/picture"
    headers = {"Accept": "image/png"}
    return transport.request("GET", path, params=params, headers=headers, retries=retries).content


def with_picture(table: str, draw: Callable[..., bytes] | None) -> str:
    """A notebook's table with what ``draw`` draws beside it; alone where there is nothing to draw it."""
    if draw is None:
        return table
    try:
        png = draw(retries=0, **_IN_NOTEBOOKS)
    except GraspDBError:
        # No mesh, no gripper, no renderer, or no service: a table is better than an error in its place.
        return table
    shown = base64.b64encode(png).decode()
    image = f"<img alt='picture' src='data:image/png;base64,{shown}' style='max-width:320px'>"
    return f"<div style='display:flex;gap:1em;align-items:flex-start'>{image}{table}</div>"
