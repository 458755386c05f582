"""Answers that the service keeps: found by id or name, asked again, deleted."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from functools import partial
from typing import Any

from graspdb import wire
from graspdb.resources.pages import Listing, Resource, segment
from graspdb.resources.pictures.asking import picture
from graspdb.resources.results import Grasp, Grasps, LikelihoodArrays, SampledPoses, table_html
from graspdb.resources.trials import Receipt, Trials
from graspdb.transport import Transport

Result = Grasps | LikelihoodArrays | SampledPoses


@dataclass(frozen=True, eq=False, repr=False)
class KeptAnswer:
    """An answer exactly as it was given, whatever became of the object's trials since.

    - ``id``, ``names``: what it is called; ``object``: the id of the object that it is about.
    - ``kind``: ``best-grasp``, ``likelihood``, ``samples`` or ``proposals``; ``result``: what that gave.
    - ``revision``: of the object then; ``object_revision``: of the object now.
    - ``question``: as the HTTP interface takes it, the seed included.
    - ``gripper``, ``protocol``, ``source``: whose trials it was about; ``trials``: how many name it.
    """

    id: str
    names: tuple[str, ...]
    object: str
    kind: str
    revision: int
    object_revision: int
    gripper: str | None
    protocol: str | None
    source: str | None
    trials: int
    created_at: datetime
    question: dict[str, Any]
    result: Result
    raw: wire.Answer

    @classmethod
    def from_wire(cls, answer: wire.Answer, transport: Transport) -> KeptAnswer:
        """From the service's answer; trials of its grasps are posted over the transport."""
        names = ("object", "kind", "revision", "object_revision", "gripper", "protocol", "source")
        fields = {name: getattr(answer, name) for name in (*names, "trials", "created_at", "question")}
        return cls(
            id=answer.answer,
            names=tuple(answer.names),
            result=_result(answer, transport),
            raw=answer,
            **fields,
        )

    def summary(self) -> dict[str, str]:
        """What a person wants to know of it, in words."""
        rows = {"answer": self.id}
        if self.names:
            rows["names"] = ", ".join(self.names)
        rows["question"] = f"{self.kind} of {self.object}"
        rows |= {name: str(value) for name, value in self.question.items() if name != "poses"}
        rows["trials of"] = ", ".join(x for x in (self.gripper, self.protocol, self.source) if x) or "all"
        newer = self.object_revision > self.revision
        rows["revision"] = f"{self.revision}" + (
            f" (the object is at {self.object_revision})" if newer else ""
        )
        rows["given"] = f"{self.created_at:%Y-%m-%d %H:%M} UTC"
        rows["tried"] = f"by {self.trials:,} trials"
        return rows

    def __repr__(self) -> str:
        named = f", names={list(self.names)}" if self.names else ""
        return f"KeptAnswer({self.id!r}, {self.kind} of {self.object!r}, revision {self.revision}{named})"

    def _repr_html_(self) -> str:
        return table_html("Answer", self.summary())


class Answers(Resource):
    """``db.answers``: the answers that the service keeps."""

    def get(self, answer: str, *, now: bool = False) -> KeptAnswer:
        """The answer with this id or name, as it was given; ``now``: to its question asked again today."""
        params = {"now": "true"} if now else None
        path = f"{self._path}/{segment(answer)}"
        found = self._transport.model(wire.Answer, "GET", path, params=params)
        return KeptAnswer.from_wire(found, self._transport)

    def delete(self, answer: str) -> None:
        """Delete an answer by its id; Conflict where trials name it.

        By a name: free that, and delete the answer where neither another name nor a trial keeps it.
        """
        self._transport.request("DELETE", f"{self._path}/{segment(answer)}")

    def list(
        self, object: str, *, name: str | None = None, kind: str | None = None
    ) -> Listing[wire.AnswerInfo]:
        """The answers about an object, the newest first; only that of a name, or to questions of a kind."""
        params = {key: value for key, value in (("name", name), ("kind", kind)) if value is not None}
        return Listing(self._transport, f"/objects/{segment(object)}/answers", wire.AnswerInfo, params)


def report_grasp(transport: Transport, object: str, grasp: Grasp, outcome: Any, **trial: Any) -> Receipt:
    """Post a trial of a grasp that an answer gave: of the answer's gripper and protocol, unless others are
    named.
    """
    if grasp.answer is not None:
        answer = transport.model(wire.Answer, "GET", f"/answers/{segment(grasp.answer)}")
        named = {"gripper": answer.gripper, "protocol": answer.protocol, "answer": grasp.answer}
        trial = named | trial
    return Trials(transport, f"/objects/{segment(object)}/trials").add(grasp, outcome, **trial)


def _result(answer: wire.Answer, transport: Transport) -> Result:
    """What the question's method gives."""
    if answer.kind == "best-grasp":
        reporter = partial(report_grasp, transport, answer.object)
        drawer = partial(picture, transport, answer.object)
        return Grasps(wire.BestGrasps.model_validate(answer.result), reporter, drawer)
    if answer.kind == "likelihood":
        return LikelihoodArrays.from_wire([wire.Likelihoods.model_validate(answer.result)])
    model = wire.Samples if answer.kind == "samples" else wire.Proposals
    return SampledPoses.from_wire(model.model_validate(answer.result))
