"""Findings in words: what is doubtful about trials, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from graspdb.wire import Finding
from graspdb_service.storage.trials.findings import FindingRow, FindingTotal
from graspdb_service.usecases.trials.findings.inspection import FIRST


class _Words(NamedTuple):
    """What is said of ``{of}`` trials; ``{detail}`` is the finding's."""

    message: str
    remedy: str


_FRAME = (
    "A grasp is the pose of the tool frame in the object's frame, in metres: its origin midway between the"
    " fingertips, z the approach, y the closing direction"
)

#: By code, the gravest first.
_WORDS = {
    "implausible-poses": _Words(
        "{of} lie more than {detail} from the object, ten times its size and the gripper's together:"
        " they can't be grasps of it",
        f"Check unit and frame. {_FRAME}",
    ),
    "looks-like-millimetres": _Words(
        "positions look like millimetres: read as metres, {of} lie too far away to be grasps of one object",
        "Multiply positions by 0.001 (on the command line --unit mm) and post them again in place of these",
    ),
    "looks-like-centimetres": _Words(
        "positions look like centimetres: read as metres, {of} lie too far away to be grasps of one object",
        "Multiply positions by 0.01 (on the command line --unit cm) and post them again in place of these",
    ),
    "looks-like-wxyz": _Words(
        "quaternions look like w, x, y, z: read as x, y, z, w few of the grasps point at the object,"
        " in the other order most do",
        "Send the components in the order x, y, z, w (on the command line --quaternion-order wxyz) and"
        " post them again in place of these",
    ),
    "another-approach-axis": _Words(
        "the tool's {detail} axis looks like the approach: few of the grasps point at the object along z,"
        " most do along {detail}",
        f"{_FRAME}. Turn the poses about their own origin so that z approaches and post them again in"
        " place of these",
    ),
    "another-closing-axis": _Words(
        "the fingers look as if they close along the tool's {detail} axis: along y few of the grasps hold the"
        " object without colliding, along {detail} most do",
        f"{_FRAME}. Turn the poses by 90 degrees about their own z and post them again in place of these",
    ),
    "out-of-reach": _Words(
        "{of} lie farther from the object than the gripper reaches ({detail} from the tool's origin)",
        f"{_FRAME}. A pose of the flange or of the gripper's base needs the way to the tool (base_to_tool)",
    ),
    "approaches-away": _Words(
        "{of} lie out of reach and approach away from the object",
        "The approach is the tool's z axis, towards the object: turn the poses whose z points back",
    ),
    "collides": _Words(
        "in {of} the open gripper overlaps the object by more than 2 mm",
        "Check the gripper's profile, the mesh's frame and how the object's pose was measured",
    ),
    "closes-on-nothing": _Words(
        "in {of} nothing is between the open fingers for them to close on",
        f"{_FRAME}. Check the gripper's profile, the mesh's frame and how the object's pose was measured",
    ),
    "wider-than-the-jaw": _Words(
        "{of} end with the fingers farther apart than the jaw opens ({detail})",
        "width_m is the distance between the fingers at the end, in metres: check its unit, which gripper it"
        " was, and the profile's max_opening_m",
    ),
    "far-from-the-rest": _Words(
        "{of} lie metres away from the others",
        "Check unit and frame of these trials. With a mesh the object's size tells what is possible",
    ),
    "turned-frame": _Words(
        "{of} came in a frame that is turned against the tool, and with convention={detail}, which says other"
        " axes than that frame's own",
        "Leave the convention out, delete the batch and post them again if the poses are of the frame as the"
        " gripper's profile has it",
    ),
    "posted-before": _Words(
        "{of} equal rows that were posted before, in pose, outcome, width, quality and time",
        "If they came twice, delete one of the batches; if each is an attempt of its own, say when it was"
        " made (measured_at)",
    ),
    "repeated-rows": _Words(
        "{of} equal another row of the same batch, in pose, outcome, width, quality and time",
        "If they came twice, delete the batch and post each once; if each is an attempt of its own, say when"
        " it was made (measured_at)",
    ),
}
#: Codes that name another unit: it explains why poses are impossible, and mending it mends them.
_UNITS = ("looks-like-millimetres", "looks-like-centimetres")
_ALL_THE_SAME = (
    "If they are right all the same, post them with ?accept_implausible=true"
    " (on the command line --accept-implausible)"
)
_ORDER = {code: place for place, code in enumerate(_WORDS)}


def of_batch(rows: Iterable[FindingRow], count: int, keys: Mapping[int, str]) -> list[Finding]:
    """A batch's findings, those of several provenances as one; ``count`` is how many trials it has, ``keys``
    those of the earlier batches that are named.
    """
    together: dict[tuple[str, str], list[FindingRow]] = {}
    for row in rows:
        together.setdefault((row.code, row.detail), []).append(row)
    found = []
    for (code, detail), same in together.items():
        number = sum(row.trial_count for row in same)
        # Rows that several earlier batches hold were looked at once.
        examined = sum({row.provenance_id: row.examined for row in same}.values())
        first = sorted({index for row in same for index in row.first_indices})[:FIRST]
        others = [keys[row.other_batch_id] for row in same if row.other_batch_id is not None]
        found.append(_finding(code, detail, number, examined, count, first, others))
    return sorted(found, key=lambda finding: _ORDER[finding.code])


def why_refused(told: Sequence[Finding]) -> str:
    """What explains impossible poses, how to mend them, and how to have them stored nevertheless."""
    units = [f"{finding.message}. {finding.remedy}" for finding in told if finding.code in _UNITS]
    reasons = units or [finding.remedy for finding in told if finding.code == "implausible-poses"]
    return f"{reasons[0]}. {_ALL_THE_SAME}"


def earlier_batches(rows: Iterable[FindingRow]) -> list[int]:
    """Internal ids of the earlier batches that findings name."""
    return [row.other_batch_id for row in rows if row.other_batch_id is not None]


def of_selection(totals: Sequence[FindingTotal]) -> list[Finding]:
    """Findings over all batches of a selection; indices are sequence numbers there."""
    found = [
        _finding(item.code, item.detail, item.trial_count, item.examined, item.examined, item.first_seqs, [])
        for item in totals
    ]
    return sorted(found, key=lambda finding: _ORDER[finding.code])


def _finding(
    code: str, detail: str, number: int, examined: int, count: int, first: list[int], batches: list[str]
) -> Finding:
    words = _WORDS[code]
    of = f"{number:,} of {examined:,} trials" + (" looked at" if examined < count else "")
    message = words.message.format(of=of, detail=detail)
    if batches:
        message += f" (batch {', '.join(batches)})"
    return Finding(
        code=code,
        count=number,
        examined=examined,
        first_indices=first,
        message=message,
        remedy=words.remedy,
        batches=batches,
    )
