"""What agents may ask: nothing here changes what is known of an object."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from pydantic import Field

from graspdb import wire
from graspdb.resources.pages import segment
from graspdb.resources.runs import computed
from graspdb.transport import Transport
from graspdb.wire.base import Request, Source
from graspdb.wire.frames.conventions import APPROACH_AND_CLOSING
from graspdb.wire.frames.gripper_frames import compose, inverse
from graspdb.wire.queries import DensityQuery
from graspdb.wire.reports import REPORTS, ReportName

MOST_POSES = 200
"""Poses an agent may ask the likelihood of at once: all that comes back is read."""
MOST_ITEMS = 64
"""Items of a list in a report that an agent gets to read."""

Object = Annotated[str, Field(description="Id of the object, as tool `objects` lists it.")]
Gripper = Annotated[
    str, Field(description="Id of the gripper, as `grippers` lists it, or a version, panda@1.")
]
Cursor = Annotated[str | None, Field(description="`next` of the answer before, for the items after it.")]
Limit = Annotated[int, Field(ge=1, le=100, description="So many items at most.")]
Axes = Annotated[
    wire.Convention, Field(description="Which axes approach and close; graspdb: the frame's own.")
]


class Questions:
    """The tools that read."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def tools(self) -> tuple[Callable[..., Any], ...]:
        """Each as a server takes it: docstring and annotations are what agents read."""
        of_objects = (self.objects, self.object_details, self.trials, self.sweeps)
        of_grippers = (self.grippers, self.frames, self.convert_pose)
        return (*of_objects, *of_grippers, self.density, self.best_grasp, self.likelihood, self.report)

    def objects(self, limit: Limit = 50, cursor: Cursor = None) -> dict[str, Any]:
        """List the objects: their ids, trials by outcome, and whether there is a mesh."""
        return self._get("/objects", limit=limit, cursor=cursor)

    def object_details(self, object: Object) -> dict[str, Any]:
        """One object: mass, friction, named frames, the mesh's box in metres, trials by outcome."""
        return self._get(f"/objects/{segment(object)}")

    def trials(
        self,
        object: Object,
        outcome: Annotated[str | None, Field(description="Only these: success, failure, slipped ...")] = None,
        source: Annotated[Source | None, Field(description="Only those of this source.")] = None,
        gripper: Annotated[str | None, Field(description="Only those with this gripper.")] = None,
        limit: Limit = 20,
        cursor: Cursor = None,
    ) -> dict[str, Any]:
        """Single trials of an object, in the order they came: pose of the tool in the object, outcome."""
        chosen = {"outcome": outcome, "source": source, "gripper": gripper}
        return self._get(f"/objects/{segment(object)}/trials", **chosen, limit=limit, cursor=cursor)

    def sweeps(self, limit: Limit = 20, cursor: Cursor = None) -> dict[str, Any]:
        """Simulations that were asked for: state, poses done, outcomes so far, what they wait for."""
        return self._get("/sweeps", limit=limit, cursor=cursor)

    def grippers(self, limit: Limit = 50, cursor: Cursor = None) -> dict[str, Any]:
        """List the grippers: opening, fingers and palm in metres, force, named frames."""
        return self._get("/grippers", limit=limit, cursor=cursor)

    def frames(self, gripper: Gripper) -> dict[str, Any]:
        """The named frames of a gripper as poses in its base, and whose axes conventions have."""
        profile = self._profile(gripper)
        return {
            "gripper": gripper,
            "poses_in_base": {name: pose.model_dump() for name, pose in profile.frames.items()},
            "tool": "midway between the fingers, z approach, y closing; it lies tip_offset_m behind the tips",
            "tip_offset_m": profile.tip_offset_m,
            "conventions": {
                name: dict(zip(("approach", "closing"), axes, strict=True))
                for name, axes in APPROACH_AND_CLOSING.items()
            },
        }

    def convert_pose(
        self,
        gripper: Gripper,
        pose: Annotated[wire.Pose, Field(description="Of the gripper's from_frame, in any reference.")],
        from_frame: Annotated[str, Field(description="The frame that the pose is of, such as flange.")],
        to_frame: Annotated[str, Field(description="The frame whose pose is wanted, such as tool.")],
        from_convention: Axes = "graspdb",
        to_convention: Axes = "graspdb",
    ) -> dict[str, Any]:
        """Where one frame of a gripper is when another is at a pose, in the same reference."""
        profile = self._profile(gripper)
        tool = compose(pose, inverse(profile.in_tool(from_frame, from_convention)))
        found = compose(tool, profile.in_tool(to_frame, to_convention))
        return {"frame": to_frame, "convention": to_convention, **found.model_dump()}

    def density(self, object: Object, selection: DensityQuery | None = None) -> dict[str, Any]:
        """What a grasp density is made of: trials, kernel widths, effective sample size, doubtful trials."""
        asked = {} if selection is None else selection.model_dump(mode="json", exclude_unset=True)
        return self._get(f"/objects/{segment(object)}/density", **asked)

    def best_grasp(self, object: Object, question: wire.BestGraspRequest | None = None) -> dict[str, Any]:
        """The best grasps within constraints, best first, with success probability and its interval.

        Give object_pose (the object in the robot's base) and frame="flange" for where the robot's flange
        goes: that is `world`. Status infeasible tells which constraints exclude each other (`conflict`), and
        what would do (`relax`). success_probability is null where too little was tried near (`support`).
        """
        body = wire.BestGraspRequest() if question is None else question
        return self._post(f"/objects/{segment(object)}/best-grasp", body)

    def likelihood(self, object: Object, question: wire.LikelihoodRequest) -> dict[str, Any]:
        """How likely grasps at given poses hold: columns in the poses' order; at most 200 poses."""
        poses = question.poses.position if isinstance(question.poses, wire.PoseColumns) else question.poses
        if len(poses) > MOST_POSES:
            raise ValueError(f"{len(poses)} poses: ask {MOST_POSES} at a time, or by the SDK")
        return self._post(f"/objects/{segment(object)}/likelihood", question)

    def report(
        self,
        object: Object,
        report: Annotated[ReportName, Field(description="Which report.")],
        options: Annotated[
            dict[str, str | float | bool] | None,
            Field(
                description="Parameters by name, vectors as 'x,y,z'; which each report has is listed above."
            ),
        ] = None,
    ) -> dict[str, Any]:
        """A report: its answer in words (`text`), what to mind (`warnings`), and its numbers.

        Long lists are cut, and `cut` says where and how long they are. The figure is the resource
        graspdb://objects/OBJECT/reports/REPORT.png.
        """
        path = f"/objects/{segment(object)}/reports/{report}"
        answer = self._transport.request("GET", path, params=options, headers={"Accept": "application/json"})
        cut: dict[str, int] = {}
        found = _readable(computed(self._transport, answer, f"the {report} report", None, 600.0), "", cut)
        return {**found, "cut": cut}

    report.__doc__ = f"{report.__doc__}\n" + "\n".join(
        f"{name}: {model.question} Options: {', '.join(model.options.model_fields)}."
        for name, model in REPORTS.items()
    )

    def _get(self, path: str, **params: Any) -> dict[str, Any]:
        found: dict[str, Any] = self._transport.json("GET", path, params=params)
        return found

    def _post(self, path: str, body: Request) -> dict[str, Any]:
        found: dict[str, Any] = self._transport.json("POST", path, body=body)
        return found

    def _profile(self, gripper: str) -> wire.GripperProfile:
        path = f"/grippers/{segment(gripper)}"
        return self._transport.model(wire.GripperInfo, "GET", path).profile


def _readable(value: Any, path: str, cut: dict[str, int]) -> Any:
    """The value with its lists' first items; ``cut`` gets the lengths of those that had more."""
    if isinstance(value, dict):
        return {name: _readable(item, f"{path}.{name}".lstrip("."), cut) for name, item in value.items()}
    if isinstance(value, list):
        if len(value) > MOST_ITEMS:
            cut[path] = max(cut.get(path, 0), len(value))
        return [_readable(item, f"{path}[]", cut) for item in value[:MOST_ITEMS]]
    return value
