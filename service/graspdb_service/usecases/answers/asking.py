"""Questions asked, and their answers kept: each has an id, and may have a name of the user's."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import orjson

from graspdb.wire import (
    BestGraspRequest,
    EstimatorInfo,
    KernelInfo,
    ProposalsRequest,
    SamplesRequest,
    Selection,
)
from graspdb.wire.queries import AnswerKind, GraspConstraints, LikelihoodOptions, LikelihoodQuery
from graspdb_density.se3 import Poses
from graspdb_service import __version__
from graspdb_service.formats.columns import json_of_columns
from graspdb_service.problems import ProblemError, conflict, invalid
from graspdb_service.storage.answers import GivenAnswer
from graspdb_service.usecases.answers.keeping import AnswerKeeper
from graspdb_service.usecases.answers.references import answer_id
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.densities.evidence import symmetries
from graspdb_service.usecases.densities.evidence.calibrations import doubts
from graspdb_service.usecases.grasps import answer, proposals, samples
from graspdb_service.usecases.grasps import likelihood as likelihoods
from graspdb_service.usecases.grasps.samples import Draw
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.runtime.asked import outage, outage_warnings
from graspdb_service.usecases.trials.pose_frames import PoseFrame, frame_of
from graspdb_service.usecases.trials.selection import Selected

#: Answers of more poses are not kept, nor larger ones.
MOST_POSES = 1_000
_MOST_BYTES = 4 * 2**20


@dataclass(kw_only=True)
class Asking(Estimators):
    """What questions are answered from, and what keeps the answers."""

    answers: AnswerKeeper


@dataclass(frozen=True, eq=False)
class Told:
    """An answer on its way out, about a selection (None: found by its name), of a revision.

    ``id`` is None where it is not kept; ``content`` is JSON where that is made already, else the answer is
    ``head`` and ``columns``.
    """

    selected: Selected | None
    revision: int
    id: str | None
    content: bytes | None
    head: Mapping[str, Any] = field(default_factory=dict)
    columns: Mapping[str, Any] = field(default_factory=dict)

    @property
    def json(self) -> bytes:
        return json_of_columns(self.head, self.columns) if self.content is None else self.content


def best_grasps(ctx: Asking, slug: str, request: GraspConstraints) -> Told:
    """The best grasps as JSON; refused as :func:`graspdb_service.usecases.grasps.answer.best_grasps`, 409
    where its name stands for another answer.
    """
    question = _question(request)
    before = _under_name(ctx, slug, "best-grasp", request.name, question)
    if before is not None:
        return before
    best, selected, stamps = answer.best_grasps(ctx, slug, request)
    asked = _Asked("best-grasp", request.name, question, selected, best.kernel, best.estimator, stamps=stamps)

    def as_json(id: str | None) -> bytes:
        return best.model_copy(update={"answer": id}).model_dump_json().encode()

    id, content = _kept(ctx, asked, as_json)
    return Told(selected, best.revision, id, content)


def likelihood(ctx: Asking, slug: str, request: LikelihoodOptions | LikelihoodQuery, poses: Poses) -> Told:
    """How likely poses are; kept for few of them."""
    few = len(poses) <= MOST_POSES
    question = _question(request)
    for name in ("position", "quaternion_xyzw"):
        question.pop(name, None)
    if few:
        question["poses"] = {
            "position": poses.positions.tolist(),
            "quaternion_xyzw": poses.quaternions_xyzw.tolist(),
        }
    _refuse_many(request.name, few)
    before = _under_name(ctx, slug, "likelihood", request.name, question)
    if before is not None:
        return before
    found = likelihoods.likelihood(ctx, slug, request, poses, request.include)
    built = found.built
    head = _head(ctx, built, built.kernel, found.estimator, found.frame)
    for key in ("reach", "calibration", "symmetry"):
        info = getattr(found, key)
        if info is not None:
            head[key] = info.model_dump()
    head["warnings"] += [*doubts(found.calibration), *symmetries.doubts(found.symmetry)]
    asked = _Asked("likelihood", request.name, question, built.selected, built.kernel, found.estimator)
    return _in_columns(ctx, asked, few, head, found.columns)


def draws(ctx: Asking, slug: str, request: SamplesRequest) -> Told:
    """Samples, or proposals where those are asked for; few of them are kept."""
    kind: AnswerKind = "proposals" if isinstance(request, ProposalsRequest) else "samples"
    few = request.count <= MOST_POSES
    _refuse_many(request.name, few)
    question = _question(request)
    before = _under_name(ctx, slug, kind, request.name, question)
    if before is not None:
        return before
    drawn: Draw
    more: dict[str, Any] = {}
    if isinstance(request, ProposalsRequest):
        drawn, criterion = proposals.propose(ctx, slug, request)
        more = {"strategy": request.strategy, "criterion": criterion}
    else:
        drawn = samples.draw(ctx, slug, request, request.count, request.seed)
    frame = frame_of(drawn.selected, request.frame, request.convention, request.near)
    estimator = drawn.estimator
    head = {
        **_head(ctx, drawn.built, drawn.kernel, estimator, frame),
        "seed": drawn.seed,
        "prior": drawn.prior,
        **more,
    }
    if drawn.symmetry is not None:
        head["symmetry"] = drawn.symmetry.model_dump()
        head["warnings"] += symmetries.doubts(drawn.symmetry)
    seed = None if "seed" in question else "seed"
    question = {**question, "seed": drawn.seed}
    asked = _Asked(kind, request.name, question, drawn.selected, drawn.kernel, estimator, seed)
    return _in_columns(ctx, asked, few, head, drawn.columns(frame))


def ask(ctx: Asking, slug: str, kind: str, question: Mapping[str, Any]) -> Told:
    """Ask a question that was kept again, of today's trials."""
    if kind == "best-grasp":
        return best_grasps(ctx, slug, BestGraspRequest.model_validate(question))
    if kind == "likelihood":
        options = {name: value for name, value in question.items() if name != "poses"}
        poses = (np.array(question["poses"][name]) for name in ("position", "quaternion_xyzw"))
        return likelihood(ctx, slug, LikelihoodOptions.model_validate(options), Poses(*poses))
    model = SamplesRequest if kind == "samples" else ProposalsRequest
    return draws(ctx, slug, model.model_validate(question))


@dataclass(frozen=True, eq=False)
class _Asked:
    """A question with what answered it; ``drawn`` names what the answer made up of it, its seed; ``stamps``
    are of what else it depends on.
    """

    kind: AnswerKind
    name: str | None
    question: Mapping[str, Any]
    selected: Selected
    kernel: KernelInfo
    estimator: EstimatorInfo | None
    drawn: str | None = None
    stamps: tuple[str, ...] = ()


def _question(request: Selection) -> dict[str, Any]:
    """What was asked, as a request takes it: the name apart, and what says no more than its default."""
    fields = type(request).model_fields
    given = request.model_dump(mode="json", exclude_unset=True, exclude={"name", "timeout_s"})
    return {
        name: value
        for name, value in given.items()
        if getattr(request, name) != fields[name].get_default(call_default_factory=True)
    }


def _head(
    ctx: Asking, built: Built, kernel: KernelInfo, estimator: EstimatorInfo, frame: PoseFrame
) -> dict[str, Any]:
    return {
        **frame.told(),
        "revision": built.revision,
        "kernel": kernel.model_dump(),
        "estimator": estimator.model_dump(),
        "selection": built.selection.model_dump(),
        "warnings": [
            *outage_warnings(built.revision),
            *ctx.evidence.warnings(built),
            *frame.warnings,
        ],
        "stale": outage() is not None,
    }


def _in_columns(
    ctx: Asking, asked: _Asked, few: bool, head: Mapping[str, Any], columns: Mapping[str, Any]
) -> Told:
    id = content = None
    if few:
        id, content = _kept(ctx, asked, lambda id: json_of_columns({**head, "answer": id}, columns))
    return Told(asked.selected, asked.selected.row.revision, id, content, {**head, "answer": id}, columns)


def _kept(ctx: Asking, asked: _Asked, make: Callable[[str | None], bytes]) -> tuple[str | None, bytes]:
    """Keep the JSON that an answer makes of its id: the id, None where it is not kept, and the JSON."""
    if outage() is not None:
        # Nobody knows what it would be today, and nothing can be written.
        return None, make(None)
    selected, question = asked.selected, orjson.dumps(asked.question, option=orjson.OPT_SORT_KEYS)
    row = selected.row
    id = answer_id(
        *(row.id, row.epoch, row.revision, asked.kind, question.decode(), asked.kernel.kind, asked.kernel.id),
        *(selected.filters, selected.stamp, asked.estimator, *asked.stamps),
        __version__,
    )
    content = make(id)
    given = GivenAnswer(
        id=id,
        object_id=row.id,
        kind=asked.kind,
        revision=row.revision,
        gripper=selected.gripper,
        protocol=selected.protocol,
        source=selected.source,
        version=__version__,
        question=question,
        result=content,
    )
    small = len(question) + len(content) <= _MOST_BYTES
    if asked.name is None:
        return (id, content) if small and ctx.answers.give(given) else (None, make(None))
    if not small:
        raise ProblemError(
            413,
            "answer-too-large",
            f"Question and answer are over the {_MOST_BYTES:,} bytes that a name keeps: ask for less",
            errors=[("name", f"keeps at most {_MOST_BYTES} bytes")],
        )
    kept = ctx.answers.name(given, asked.name)
    if kept is not None:
        return id, kept
    # Somebody else has just taken the name, perhaps for the same question.
    own = {key: value for key, value in asked.question.items() if key != asked.drawn}
    before = _under_name(ctx, row.slug, asked.kind, asked.name, own)
    if before is None:
        raise _name_taken(asked.name)
    return before.id, before.json


def _refuse_many(name: str | None, few: bool) -> None:
    if name is not None and not few:
        raise invalid("name", f"answers of at most {MOST_POSES:,} poses are kept under a name")


def _under_name(
    ctx: Asking, slug: str, kind: str, name: str | None, question: Mapping[str, Any]
) -> Told | None:
    """The answer that a name stands for, to the question it was given to; 409 for any other question."""
    if name is None:
        return None
    with ctx.database.read() as tx:
        row = require(tx, slug)
    found = ctx.answers.named(name)
    if found is None:
        return None
    kept, asked, result = found
    # A seed that was drawn is the answer's, not the question's.
    own = {key: value for key, value in asked.items() if key in question or key != "seed"}
    if (kept.object_id, kept.kind, own) != (row.id, kind, question):
        raise _name_taken(name)
    if row.revision > kept.revision:
        result = orjson.dumps({**orjson.loads(result), "newer_revision": row.revision})
    return Told(None, kept.revision, kept.id, result)


def _name_taken(name: str) -> ProblemError:
    return conflict(
        "name-taken",
        f"The name {name!r} stands for the answer to another question (GET /answers/{name} shows it):"
        f" choose another name, or free it with DELETE /answers/{name}",
    )
