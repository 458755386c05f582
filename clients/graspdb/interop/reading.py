"""A file's grasps: what it leaves open settled, read by pieces, with a report of what became of it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import Annotated, Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from graspdb.files.trials import METRES
from graspdb.interop import joints
from graspdb.interop.formats import tables
from graspdb.interop.formats.columns import STATED, parsed
from graspdb.interop.formats.known import FORMATS, TIPS, Format, recognised
from graspdb.interop.formats.source import SourceFile, Wishes
from graspdb.interop.frames import frames_of, to_graspdb, to_tool
from graspdb.interop.grasps import NO_OUTCOME, Codes, FileGrasps, Floats, Raw, Report, joined, problem
from graspdb.interop.outcomes import Rule, named, rule_of
from graspdb.interop.placing import Placing, swapped_order
from graspdb.options import Option, Vector, known_keywords
from graspdb.poses import as_vector7, matrices
from graspdb.wire import CONVENTIONS, GripperInfo, GripperProfile
from graspdb.wire.base import MAX_QUALITIES
from graspdb.wire.frames.conventions import OWN_AXES
from graspdb.wire.frames.gripper_frames import TOOL

#: Limits of a quality's number and of its name.
_LARGEST, _LONGEST = 1e9, 64

_WHERE_OBJECT = (
    "(--object-pose x,y,z,qx,qy,qz,qw; the identity 0,0,0,0,0,0,1 where it is the object's own frame)"
)


@dataclass
class Reading:
    """One file that is read: again and again from its beginning, by pieces, with a new report each time.

    ``frames`` are poses (4, 4) of frames in the object's, by names by which the file may call them.
    """

    source: SourceFile
    kind: Format
    placing: Placing
    wishes: Wishes
    rule: Rule | None
    outcome: int | None
    assumed: Sequence[str] = ()
    gripper: GripperProfile | None = None
    frames: Mapping[str, Floats] = field(default_factory=dict)

    def raws(self, report: Report) -> Iterator[Raw]:
        """The file's grasps as they stand in it, without those that are to be left out."""
        order = self.wishes.quaternion_order
        for raw in self.kind.read(self.source, self.wishes, report):
            if order is not None and (raw.quaternion is None or raw.order is None):
                told = "has no quaternions that might be in another order: leave --quaternion-order out"
                raise problem(self.source.name, told)
            if order is not None and raw.quaternion is not None and raw.order != order:
                raw = replace(raw, quaternion=swapped_order(raw.quaternion, raw.order), order=order)
            yield self._usable(raw, self.placing_by(report), report)

    def new_report(self) -> Report:
        """A report of nothing read yet."""
        placing = self.placing
        report = Report(self.source.name, self.kind.name, placing.frame, placing.convention)
        for told in self.assumed:
            report.assume(told)
        return report

    def chunks(self, report: Report) -> Iterator[FileGrasps]:
        """The file's grasps as ours; the report says more with each piece. FileProblem in one line."""
        for raw in self.raws(report):
            placing = self.placing_by(report)
            try:
                poses = placing.place(raw)
            except ValueError as error:
                raise problem(self.source.name, f"{error}; --drop-unusable leaves such grasps out") from None
            codes, kept = self._outcomes(raw, report)
            more = joints.kept(raw.more, self.gripper, report)
            found = FileGrasps(*poses, codes, self._qualities(raw, report), more)
            if not kept.all():
                found = found.part(kept)
            report.count(found)
            if len(found):
                yield found

    def _usable(self, raw: Raw, placing: Placing, report: Report) -> Raw:
        """The grasps that are taken: all of them, unless those without pose or outcome are to be left out."""
        if not self.wishes.drop_unusable:
            return raw
        kept = np.ones(len(raw), dtype=bool)
        faults = list(placing.faults(raw))
        if raw.outcome is not None and self.rule is None:
            faults.append((raw.outcome == NO_OUTCOME, "has no outcome"))
        for bad, why in faults:
            report.leave_out(why, int((bad & kept).sum()))
            kept &= ~bad
        return raw if kept.all() else raw.part(kept)

    def _qualities(self, raw: Raw, report: Report) -> dict[str, Floats]:
        """The qualities under names that are stored; one line names a number that can't be."""
        found: dict[str, Floats] = {}
        for name, values in raw.qualities.items():
            beyond = np.flatnonzero(np.abs(values) > _LARGEST)
            if beyond.size:
                place = int(beyond[0])
                told = (
                    f"grasp {raw.first + place}: {name} is {values[place]:g}; at most {_LARGEST:g} is stored"
                )
                raise problem(self.source.name, told)
            plain = re.sub(r"[^A-Za-z0-9._/-]", "_", name)[:_LONGEST].lstrip("._/-") or "quality"
            if plain != name:
                report.map(f"{name} to the quality {plain}")
            if len(found) == MAX_QUALITIES:
                report.drop(f"{name}: a trial has at most {MAX_QUALITIES} qualities")
                continue
            found[plain] = values
        return found

    def placing_by(self, report: Report) -> Placing:
        """How the file's poses are placed, by the names that it gives to the frame they are in; FileProblem
        where that frame is not known.
        """
        if self.placing.into_object is not None or not report.references:
            return self.placing
        names = report.references
        if len(names) > 1 or names[0] not in self.frames:
            told = ", ".join(names[:4])
            raise problem(
                self.source.name, f"has poses in {told}: give the object's pose in it {_WHERE_OBJECT}"
            )
        frame = self.frames[names[0]]
        report.recognise(f"poses in {names[0]}, which is the object's")
        return self.placing if np.array_equal(frame, np.eye(4)) else replace(self.placing, into_object=frame)

    def _outcomes(self, raw: Raw, report: Report) -> tuple[Codes, Any]:
        """Outcomes (N,), and which grasps have one."""
        every = np.ones(len(raw), dtype=bool)
        rule = self.rule or (None if raw.outcome is not None else self.kind.rule)
        if rule is None and raw.outcome is not None:
            report.rule = report.rule or "as the file says"
            return raw.outcome, every
        if rule is not None and rule.quality in raw.qualities:
            values = raw.qualities[rule.quality]
            told = ~np.isnan(values)
            if self.rule is None:
                beyond = told & ((values < 0) | (values > 1))
                if beyond.any():
                    row = int(np.argmax(beyond))
                    raise problem(
                        self.source.name,
                        f"grasp {raw.first + row}: {rule.quality} is {values[row]:g}, no probability: say"
                        f" what is a success (--success-from {rule.quality} --success-above X)",
                    )
                report.assume(str(rule))
            report.rule = str(rule)
            report.leave_out(f"has no {rule.quality}", int((~told).sum()))
            return rule.codes(values), told
        if self.rule is not None:
            there = ", ".join(raw.qualities) or "none"
            raise problem(self.source.name, f"has no quality {self.rule.quality!r}; there are {there}")
        if self.outcome is not None:
            report.rule = "the same outcome for all, as was said"
            return np.full(len(raw), self.outcome, dtype=np.uint8), every
        scores = ", ".join(raw.qualities)
        raise problem(
            self.source.name,
            "says of no grasp what became of it: "
            + (
                f"make outcomes of a score ({scores}) with --success-from QUALITY --success-above X, or"
                if scores
                else ""
            )
            + " give one outcome for all with --outcome success",
        )


class ReadOptions(TypedDict, total=False):
    """What a file leaves open, or what somebody knows better.

    - ``format``: ``auto``, or one of :data:`FORMATS`.
    - ``frame``: which frame of the gripper its poses are of; by default the format's own.
    - ``convention``: which axes approach and close: a name of :data:`graspdb.wire.CONVENTIONS`, or
      the axes themselves, as in ``z/x``. ``graspdb`` and ``moveit`` are the frame's own, as the gripper's
      profile has them.
    - ``unit``, ``scale``: positions are in this unit, and are multiplied.
    - ``columns``: of a table, ``{"position": "px:py:pz", "quaternion_wxyz": "q", "quality.force": "f"}`` or
      the same as text; ``quaternion_order`` whatever their names say.
    - ``only``: take what belongs to this scene or object: ``{"object_id": "5"}``.
    - ``object_pose``: the object in the frame that the file's poses are in: (4, 4) or x y z qx qy qz qw.
    - ``success_from`` with ``success_above`` or ``success_below``: the rule that makes outcomes of a quality.
    - ``outcome``: one outcome for all grasps of which the file says none.
    - ``drop_unusable``: leave out grasps that have no pose (a number that is not finite, no rotation) or, in
      a table, no outcome; without it they are refused, and the report says how many were left out.
    """

    format: Annotated[str | None, Option(f"auto, or one of {', '.join(FORMATS)}.")]
    frame: Annotated[
        str | None, Option("Frame of the gripper that the poses are of: base, tool, ... [the format's own].")
    ]
    convention: Annotated[
        str | None,
        Option(f"Axes of approach and closing: {', '.join(CONVENTIONS)}, or as in z/x [the format's own]."),
    ]
    unit: Annotated[str | None, Option("What positions are in: m, cm, mm or in [the format's own].")]
    scale: Annotated[float | None, Option("Multiplies positions.")]
    columns: Annotated[
        str | Mapping[str, str] | None,
        Option("Columns of a table: position=px:py:pz,quaternion_wxyz=q,outcome=ok,quality.force=f."),
    ]
    quaternion_order: Annotated[
        str | None, Option("The order of quaternions: xyzw or wxyz, whatever their names say.")
    ]
    only: Annotated[str | Mapping[str, str] | None, Option("Take those of one scene or object: object_id=5.")]
    object_pose: Annotated[
        ArrayLike | Any | None, Vector("The object in the frame of the file's poses.", of="x,y,z,qx,qy,qz,qw")
    ]
    success_from: Annotated[str | None, Option("The quality that decides what is a success.")]
    success_above: Annotated[float | None, Option("A success is above this.")]
    success_below: Annotated[float | None, Option("A success is below this, where a lower score is better.")]
    outcome: Annotated[str | None, Option("What became of all of which the file does not say it.")]
    drop_unusable: Annotated[bool, Option("Leave out grasps without a pose or an outcome, and say how many.")]


def opened(
    path: str | PathLike[str],
    gripper: GripperProfile | GripperInfo | None = None,
    frames: Mapping[str, Floats] | None = None,
    /,
    **options: Unpack[ReadOptions],
) -> Reading:
    """A file, its format recognised and everything that it leaves open settled: see :func:`read`."""
    known_keywords(ReadOptions, options, "read")
    rule = rule_of(options.get("success_from"), options.get("success_above"), options.get("success_below"))
    order, outcome, place = (
        options.get("quaternion_order"),
        options.get("outcome"),
        options.get("object_pose"),
    )
    if order not in (None, "xyzw", "wxyz"):
        raise ValueError(f"quaternion_order is {order!r}; expected xyzw or wxyz")
    columns = parsed(options.get("columns") or {})
    source = SourceFile(path)
    only = _pairs(options.get("only") or {})
    kind = recognised(source, options.get("format") or "auto", only.get("topic"))
    if columns and not kind.table:
        raise ValueError(f"columns are named in tables; {source.name} is {kind.name}")
    if place is not None and any(name.startswith("object_") for name in columns):
        raise ValueError("the object's pose is in columns and in --object-pose: give one of them")
    if place is None and kind.reference != "object":
        raise problem(
            source.name,
            f"is {kind.name}, whose poses are in the {kind.reference}'s frame: give the object's pose in it"
            f" {_WHERE_OBJECT}{kind.also}",
        )
    profile = gripper.profile if isinstance(gripper, GripperInfo) else gripper
    assumed: list[str] = []
    stated = tables.stated(source, kind.name) if kind.table else {}
    placing = _placing(source, kind, profile, options, assumed, stated)
    # Where somebody says it, a column of that name may be about anything.
    said = tuple(name for name in STATED if options.get(name) is not None)
    stated = {name: value for name, value in stated.items() if name not in said}
    dropping = bool(options.get("drop_unusable", False))
    wishes = Wishes(order, columns, only, () if rule is None else (rule.quality,), dropping, stated, said)
    decided = None if outcome is None else named(outcome)
    return Reading(source, kind, placing, wishes, rule, decided, assumed, profile, frames or {})


def _placing(
    source: SourceFile,
    kind: Format,
    profile: GripperProfile | None,
    options: ReadOptions,
    assumed: list[str],
    stated: Mapping[str, str],
) -> Placing:
    unit, scale, place = options.get("unit"), options.get("scale"), options.get("object_pose")
    scale = 1.0 if scale is None else scale
    if unit is not None and unit not in METRES:
        raise ValueError(f"unit is {unit!r}; expected one of {', '.join(METRES)}")
    if not (np.isfinite(scale) and scale > 0):
        raise ValueError(f"scale is {scale}; expected a positive number")
    for name, value in stated.items():
        if options.get(name) not in (None, value):
            assumed.append(f"{name} {options.get(name)}, as was said, though the file says {value}")
    frame, axes = _settled(
        source,
        kind,
        options.get("frame") or stated.get("frame"),
        options.get("convention") or stated.get("convention"),
        profile,
        assumed,
    )
    if unit is None:
        assumed.append(f"positions in {kind.unit}")
    if scale != 1.0:
        assumed.append(f"positions times {scale:g}, as was said")
    if frame == TIPS:
        if profile is None:
            raise ValueError(f"{kind.name} says where the fingertips are: name the gripper")
        assumed.append("the fingertips are where the file has them, and the gripper's base follows from that")
        fixed = np.eye(4)
        fixed[:3, :3] = to_graspdb(axes)
    else:
        fixed = to_tool(frame, axes, profile)
        if profile is not None and frame == "base":
            tips = fixed[:3, 3] + profile.tip_offset_m * fixed[:3, 2]
            ahead = float(tips @ to_graspdb(axes)[:, 2])
            assumed.append(f"fingertips {ahead:.4f} m ahead of the base, as the named gripper has them")
    return Placing(
        frame,
        axes,
        METRES[unit or kind.unit] * scale,
        fixed,
        0.0 if profile is None else profile.tip_offset_m,
        None if place is None else np.asarray(np.linalg.inv(_pose_matrix(place)), dtype=np.float64),
        axes_told=not kind.table and kind.convention is not None and options.get("convention") is None,
    )


def _settled(
    source: SourceFile,
    kind: Format,
    frame: str | None,
    convention: str | None,
    profile: GripperProfile | None,
    assumed: list[str],
) -> tuple[str, str]:
    """The frame and the axes of a file's poses: those given, else the format's own; refused without."""
    missing = [
        flag
        for flag, given, own in (
            ("--frame", frame, kind.frame),
            ("--convention", convention, kind.convention),
        )
        if given is None and own is None
    ]
    if missing:
        told = (
            "of which frame its poses are, nor what its axes are" if len(missing) > 1 else "what its axes are"
        )
        frames = "; frames are base, tool, or another of the gripper's" if "--frame" in missing else ""
        raise problem(
            source.name,
            f"is {kind.name}, which does not say {told}: give {' and '.join(missing)} (conventions are"
            " graspdb: the frame's own axes, as the gripper's profile has them; acronym: z approaches and x"
            f" closes; graspnet: x and y; or the axes themselves, as in z/x{frames})",
        )
    chosen, axes = frame or kind.frame, convention or kind.convention
    assert chosen is not None
    assert axes is not None
    to_graspdb(axes)
    if frame is None and chosen == "flange" and "flange" not in frames_of(profile):
        raise problem(
            source.name,
            "has poses of the end effector's parent link, and the gripper has no frame flange: say which"
            " frame of the gripper that link is (--frame base, for the Franka Hand's own, or another)",
        )
    if frame is None:
        what = "of the fingertips' place" if chosen == TIPS else f"of the gripper's {chosen}"
        assumed.append(f"poses {what}, the format's own")
    if convention is None:
        approach, closing = _letters(axes)
        own = axes in OWN_AXES and chosen not in (TIPS, TOOL)
        assumed.append(
            f"the own axes of the gripper's {chosen}, as its profile has them"
            if own
            else f"{approach} approaches and {closing} closes, the format's own"
        )
    if kind.assumed and convention is None:
        assumed.append(kind.assumed)
    return chosen, axes


def _letters(convention: str) -> tuple[str, str]:
    axes = to_graspdb(convention)

    def letter(column: Floats) -> str:
        place = int(np.argmax(np.abs(column)))
        return ("-" if column[place] < 0 else "") + "xyz"[place]

    return letter(axes[:, 2]), letter(axes[:, 1])


def _turned(rotation: Floats) -> Floats:
    fixed = np.eye(4)
    fixed[:3, :3] = rotation
    return fixed


def _pose_matrix(pose: ArrayLike) -> Floats:
    row = as_vector7(pose)
    return matrices(row[:3], row[3:])


def _pairs(text: str | Mapping[str, str]) -> dict[str, str]:
    if isinstance(text, Mapping):
        return {str(key): str(value) for key, value in text.items()}
    pairs = [pair.partition("=") for pair in text.split(",") if pair.strip()]
    if any(not sign for _, sign, _ in pairs):
        raise ValueError(f"only is NAME=VALUE; this is {text!r}")
    return {key.strip(): value.strip() for key, _, value in pairs}


def read(
    path: str | PathLike[str],
    *,
    gripper: GripperProfile | GripperInfo | None = None,
    **options: Unpack[ReadOptions],
) -> FileGrasps:
    """All grasps of a file as poses of the tool in the object's frame, their outcomes, and the report.

    ``gripper`` is needed where poses are of another of its frames than the tool: its profile, or
    ``db.grippers.get("panda")``; the rest are :class:`ReadOptions`. Nothing in a file is run or unpickled.
    ValueError, in one line, for what can't be read or leaves open what nobody said.
    """
    reading = opened(path, gripper, **options)
    report = reading.new_report()
    return replace(joined(list(reading.chunks(report))), report=report)
