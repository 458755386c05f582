"""An object's trials and batches from the client's side: add them, page through them, delete them."""

from __future__ import annotations

import json
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Annotated, Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from typing_extensions import Unpack

from graspdb import wire
from graspdb.errors import GraspDBError, InvalidInput, add_note
from graspdb.files import arrow
from graspdb.options import Option, known_keywords
from graspdb.poses import as_poses, first_masked, listed, numbers, pose_frame
from graspdb.resources.pages import Listing, Resource, segment
from graspdb.resources.results import TrialArrays
from graspdb.resources.selection import AnswerFrame, PoseFrame, TrialSelection, answer_frame

CHUNK_TRIALS = 50_000
"""Trials a request: some 10 MB of JSON, well under the service's default body limit."""

ProgressCallback = Callable[[int, int], None]
"""Called with the trials stored so far and their total."""


@dataclass(frozen=True)
class Receipt:
    """What an upload stored: its batches (one a request), the number of trials, the object's revision.

    ``findings`` are what the service found doubtful about the trials, a batch's after the other's, their
    ``first_indices`` counted from the upload's first trial. An import tells in ``already_stored`` how many of
    ``inserted`` an earlier run of it had stored.
    """

    batches: tuple[str, ...]
    inserted: int
    revision: int
    findings: tuple[wire.Finding, ...] = ()
    already_stored: int = 0

    @property
    def batch(self) -> str:
        """The batch, where the upload fitted into one."""
        if len(self.batches) != 1:
            raise ValueError(f"this upload went into {len(self.batches)} batches: see .batches")
        return self.batches[0]


class DoubtfulTrials(UserWarning):
    """The service stored trials and found something doubtful about them: see ``Receipt.findings``."""


class Sending(TypedDict, total=False):
    """How trials are sent.

    They go ``chunk`` a request; each is stored wholly or not at all, as its own batch. Repeat a failed upload
    with the same ``idempotency_key``, data and ``chunk``, and nothing is stored twice (another ``chunk`` is
    refused); one that breaks off or is interrupted names the key in its notes. Trials too far from a
    known object to be grasps of it are refused, unless ``accept_implausible``. ``progress=True`` shows a bar;
    a function is called with trials stored and total.
    """

    idempotency_key: Annotated[
        str | None, Option("Repeat a failed upload with the same key: nothing is stored twice.")
    ]
    chunk: Annotated[int, Option("Trials a request, each a batch.", min=1, default=CHUNK_TRIALS)]
    accept_implausible: Annotated[
        bool,
        Option(
            "Store trials, too, that lie too far from the object to be grasps of it.",
            flag="--accept-implausible",
            default=False,
        ),
    ]
    progress: bool | ProgressCallback


class Upload(Sending, PoseFrame, total=False):
    """How trials are sent (:class:`Sending`), and what the poses are of (:class:`PoseFrame`, each of its
    trial's gripper).
    """


class TrialFilters(TrialSelection, AnswerFrame, total=False):
    """Which trials to list: a :class:`TrialSelection`, and ``outcome``, ``batch``, ``since_revision``,
    ``withdrawn`` and ``licence``; and what their poses are to be of (:class:`AnswerFrame`), each of its
    trial's gripper.
    """

    outcome: Annotated[str | None, Option("Only this outcome.")]
    batch: Annotated[str | None, Option("Only this batch.")]
    since_revision: Annotated[int | None, Option("Only what came or was changed after this revision.")]
    withdrawn: Annotated[bool | None, Option("Only withdrawn trials, or none of them; else all, marked.")]
    licence: Annotated[str | None, Option("Only what came in batches under this licence.")]


class TrialListing(Listing[wire.TrialOut]):
    """Stored trials in commit order; iterate, or read them all as arrays."""

    def documents(self) -> Iterator[dict[str, Any]]:
        """All of them as mappings with the fields of the HTTP interface, streamed: one is held at a time.

        Far faster than iterating, which makes and checks a :class:`~graspdb.wire.TrialOut` of each.
        """
        return map(json.loads, self._transport.lines(self._path, params=self._params))

    def arrays(self) -> TrialArrays:
        """All of them as columns."""
        return TrialArrays.of(tuple(self), self._params.get("frame"), self._params.get("convention"))

    def to_pandas(self) -> Any:
        """All of them as a DataFrame (extra ``pandas``)."""
        return self.arrays().to_pandas()


class Trials(Resource):
    """``mug.trials``: the trials of one object."""

    # long: most of it says what its keywords are.
    def add(
        self,
        poses: ArrayLike | Any,
        outcomes: ArrayLike | str | bool,
        *,
        gripper: str | None = None,
        source: str | None = None,
        protocol: str | None = None,
        engine: str | None = None,
        proposal_density: ArrayLike | None = None,
        attempts: ArrayLike | None = None,
        successes: ArrayLike | None = None,
        quality: ArrayLike | None = None,
        qualities: Mapping[str, ArrayLike] | None = None,
        width_m: ArrayLike | None = None,
        pose_covariance: ArrayLike | None = None,
        measured_at: datetime | Sequence[datetime | None] | ArrayLike | None = None,
        metadata: Mapping[str, Any] | Sequence[Mapping[str, Any] | None] | None = None,
        answer: str | Sequence[str | None] | None = None,
        achieved_poses: ArrayLike | Any | None = None,
        licence: str | None = None,
        citation: str | None = None,
        origin: Mapping[str, str] | wire.Origin | None = None,
        **upload: Unpack[Upload],
    ) -> Receipt:
        """Store grasp trials; how they are sent: :class:`Upload`. ValueError if shapes or poses are wrong.

        What the service finds doubtful about them is in the receipt's ``findings``, and warned of as
        :class:`DoubtfulTrials`.

        - ``poses``: tool frames, or ``frame``, in the object frame: (N, 4, 4) matrices or (N, 7) rows
          x y z qx qy qz qw, or one pose; a :class:`~graspdb.resources.results.Grasp` or samples go too.
        - ``outcomes``: (N,) booleans or outcome names; a single one goes for all poses.
        - ``gripper``, ``source``, ``protocol``, ``engine`` (as in ``pybullet 3.2.7``): of the whole upload.
        - ``proposal_density``: 1/(m^3 rad^3), (N,) or one number: the density the poses were drawn from.
        - ``attempts``, ``successes``: (N,) or one whole number, NaN for once: how often a grasp was tried and
          succeeded. It counts as one attempt that succeeded by that share; from half on it is a success.
        - ``quality``, ``width_m``: (N,) or one number; NaN where unknown. Width of the jaw's opening, m.
        - ``qualities``: scores by name, each as ``quality``, at most 32; the first stands for ``quality``,
          too, where that is unknown.
        - ``pose_covariance``: (6, 6) or (N, 6, 6), translation first, along and about the frame's axes.
        - ``measured_at``, ``metadata``: one for all, or a sequence with one a trial; NumPy's times are UTC.
        - ``answer``: id or name of the answer that was tried, one for all or one a trial: ``best.answer``.
        - ``achieved_poses``: where the tool was after all, as ``poses``, which are then what was commanded;
          in a list None where it is unknown. Estimates take the achieved pose where there is one.
        - ``licence`` (best by its SPDX name), ``citation``, ``origin`` (``file``, ``format``, ``sha256``): of
          the whole upload, kept with its batches.
        """
        given = as_poses(poses)
        framed = pose_frame(poses, upload.get("frame"), upload.get("convention"))
        count = len(given.position)
        columns = {**given.columns(), "outcome": _outcomes(outcomes, count)}
        given_numbers = {"proposal_density": proposal_density, "quality": quality, "width_m": width_m}
        columns |= {name: numbers(name, x, count) for name, x in given_numbers.items() if x is not None}
        for name, several in (("attempts", attempts), ("successes", successes)):
            if several is not None:
                columns[name] = [_whole(x) for x in numbers(name, several, count)]
        scores = {name: numbers(f"qualities[{name!r}]", x, count) for name, x in (qualities or {}).items()}
        if pose_covariance is not None:
            covariances = np.asarray(pose_covariance, dtype=np.float64)
            columns["pose_covariance"] = listed("pose_covariance", covariances, count, (6, 6))
        if measured_at is not None:
            columns["measured_at"] = _times(measured_at, count)
        shared: dict[str, Any] = {"gripper": gripper, "source": source, "protocol": protocol}
        shared |= {"engine": engine, "licence": licence, "citation": citation}
        if origin is not None:
            told = wire.Origin.model_validate(origin)
            shared["origin"] = told.model_dump(exclude_none=True)
        if isinstance(metadata, Mapping):
            shared["metadata"] = dict(metadata)
        elif metadata is not None:
            columns["metadata"] = _each("metadata", metadata, Mapping, count)
        if isinstance(answer, str):
            shared["answer"] = answer
        elif answer is not None:
            columns["answer"] = _each("answer", answer, str, count)
        if achieved_poses is not None:
            columns["achieved_pose"] = _achieved(achieved_poses, count)

        def part(start: int, stop: int) -> dict[str, Any]:
            own: dict[str, Any] = {name: values[start:stop] for name, values in columns.items()}
            if scores:
                own["qualities"] = {name: values[start:stop] for name, values in scores.items()}
            return {"columns": own}

        return self._send(part, shared, count, upload, framed)

    def add_records(
        self,
        /,
        records: Iterable[Mapping[str, Any]],
        *,
        chunk: int = CHUNK_TRIALS,
        idempotency_key: str | None = None,
        accept_implausible: bool = False,
        progress: bool | ProgressCallback = False,
        frame: str | None = None,
        convention: str | None = None,
        **shared: Any,
    ) -> Receipt:
        """Store trials given as mappings with the fields of the HTTP interface; sent as :meth:`add` does.

        ``shared`` stands once for all that do not say it themselves: ``gripper``, ``source``, ``protocol``,
        ``engine``, ``proposal_density``, ``metadata``, ``answer``; and ``licence``, ``citation``, ``origin``
        of the batches. ``frame`` and ``convention`` are what all poses are of, those achieved, too.
        """
        trials = [dict(record) for record in records]
        if not trials:
            raise ValueError("give at least one trial")
        upload: Upload = {
            "chunk": chunk,
            "idempotency_key": idempotency_key,
            "accept_implausible": accept_implausible,
            "progress": progress,
        }
        framed = pose_frame(None, frame, convention)
        return self._send(
            lambda start, stop: {"trials": trials[start:stop]}, shared, len(trials), upload, framed
        )

    def add_columns(
        self,
        parts: Iterable[Mapping[str, Any]],
        total: int,
        /,
        *,
        idempotency_key: str | None = None,
        accept_implausible: bool = False,
        progress: bool | ProgressCallback = False,
        known_revision: int | None = None,
        way_on: str | None = None,
        **shared: Any,
    ) -> Receipt:
        """Store trials that come by pieces, each a batch: columns of the HTTP interface as arrays or lists.

        ``total`` is how many there are in all, for ``progress``; no more than one piece is held at a time.
        They go as Arrow where pyarrow is installed and the service takes it, else as JSON. ``shared`` stands
        once for all, as in :meth:`add_records`. By the object's ``known_revision`` before it the receipt
        tells what was ``already_stored``; ``way_on`` is told where it breaks off, by default the key.
        """
        upload: Upload = {
            "chunk": max(1, total),
            "idempotency_key": idempotency_key,
            "accept_implausible": accept_implausible,
            "progress": progress,
        }
        shared = {name: value for name, value in shared.items() if value is not None}
        return self._post(
            ((len(part["outcome"]), {"columns": part}) for part in parts),
            shared,
            total,
            upload,
            {},
            known_revision,
            way_on,
        )

    def _send(
        self,
        part: Callable[[int, int], dict[str, Any]],
        shared: Mapping[str, Any],
        count: int,
        upload: Upload,
        framed: Mapping[str, str],
    ) -> Receipt:
        known_keywords(Upload, upload, "add")
        chunk = upload.get("chunk", CHUNK_TRIALS)
        if chunk < 1:
            raise ValueError("chunk must be at least 1")
        shared = {name: value for name, value in shared.items() if value is not None}
        stops = [min(start + chunk, count) for start in range(0, count, chunk)]
        pieces = ((stop - start, part(start, stop)) for start, stop in zip([0, *stops], stops, strict=False))
        return self._post(pieces, shared, count, upload, framed)

    def _post(
        self,
        pieces: Iterable[tuple[int, Mapping[str, Any]]],
        shared: Mapping[str, Any],
        count: int,
        upload: Upload,
        framed: Mapping[str, str],
        known_revision: int | None = None,
        way_on: str | None = None,
    ) -> Receipt:
        """A request for each piece; warns of findings for whoever called the method that called this."""
        key = upload.get("idempotency_key") or str(uuid.uuid4())
        params = {**framed, **({"accept_implausible": "true"} if upload.get("accept_implausible") else {})}
        receipts: list[wire.BatchReceipt] = []
        findings: list[wire.Finding] = []
        start = stop = 0
        with _upload_bar(upload.get("progress", False)) as report:
            try:
                for number, (size, piece) in enumerate(pieces):
                    stop = start + size
                    # The first piece's key says nothing of how many there are: cut otherwise, under the same
                    # key, it has another body, and is refused.
                    own = f"{key}-{number}" if number else key
                    receipt = self._sent(piece, shared, params=params, idempotency_key=own)
                    receipts.append(receipt)
                    findings += [_from_row(finding, start) for finding in receipt.findings]
                    start = stop
                    report(stop, count)
            except (GraspDBError, KeyboardInterrupt) as error:
                for note in _broken_off(error, receipts, (start, stop), key, way_on):
                    add_note(error, note)
                raise
        for finding in findings:
            # To whoever called add, which called what called this.
            warnings.warn(f"{finding.message}. {finding.remedy}", DoubtfulTrials, stacklevel=4)
        return Receipt(
            batches=tuple(receipt.batch for receipt in receipts),
            inserted=sum(receipt.inserted for receipt in receipts),
            revision=receipts[-1].revision,
            findings=tuple(findings),
            already_stored=sum(
                receipt.inserted
                for receipt in receipts
                if known_revision is not None and receipt.revision <= known_revision
            ),
        )

    def _sent(self, piece: Mapping[str, Any], shared: Mapping[str, Any], **options: Any) -> wire.BatchReceipt:
        """One request: as Arrow where its columns are arrays and both sides can, else as JSON."""
        columns = piece.get("columns", {})
        if isinstance(columns.get("position"), np.ndarray):
            if arrow.available():
                headers = {"Content-Type": arrow.MEDIA_TYPE}
                content = arrow.encoded(columns, shared)
                try:
                    return self._transport.model(
                        wire.BatchReceipt, "POST", self._path, content=content, headers=headers, **options
                    )
                except GraspDBError as error:
                    # The service was installed without Arrow.
                    if error.status != 415:
                        raise
            piece = {"columns": {name: _plain(values) for name, values in columns.items()}}
        return self._transport.model(
            wire.BatchReceipt, "POST", self._path, body={**shared, **piece}, **options
        )

    def get(
        self,
        seq: int,
        *,
        frame: str | None = None,
        convention: str | None = None,
        near: ArrayLike | None = None,
    ) -> wire.TrialInfo:
        """One trial, its pose as :class:`AnswerFrame` says, and in ``history`` what it was before it was
        corrected.
        """
        params = answer_frame(frame, convention, near)
        return self._transport.model(wire.TrialInfo, "GET", f"{self._path}/{int(seq)}", params=params)

    def withdraw(self, seq: int, *, reason: str | None = None) -> None:
        """Take a trial out of every count and estimate; Conflict for a trial of a sweep.

        It is kept, marked, and :meth:`correct` takes it back in.
        """
        params = None if reason is None else {"reason": reason}
        self._transport.request("DELETE", f"{self._path}/{int(seq)}", params=params)

    def correct(
        self,
        seq: int,
        *,
        outcome: str | bool | None = None,
        metadata: Mapping[str, Any] | None = None,
        withdrawn: bool | None = None,
        reason: str | None = None,
        frame: str | None = None,
        convention: str | None = None,
        near: ArrayLike | None = None,
    ) -> wire.TrialInfo:
        """Change a trial's outcome or metadata, withdraw it or take it back; what is None stays.

        What it was stays in its ``history``, with the ``reason``; its pose is given as :class:`AnswerFrame`
        says. Conflict for a trial of a sweep.
        """
        given = {"outcome": outcome, "metadata": metadata, "withdrawn": withdrawn, "reason": reason}
        body = {name: value for name, value in given.items() if value is not None}
        params = answer_frame(frame, convention, near)
        path = f"{self._path}/{int(seq)}"
        return self._transport.model(wire.TrialInfo, "PATCH", path, body=body, params=params)

    def list(self, **filters: Unpack[TrialFilters]) -> TrialListing:
        """The stored trials that match, read page by page as they are iterated."""
        params = known_keywords(TrialFilters, filters, "list")
        params |= answer_frame(params.get("frame"), params.get("convention"), params.get("near"))
        return TrialListing(self._transport, self._path, wire.TrialOut, params)

    def __iter__(self) -> Iterator[wire.TrialOut]:
        return iter(self.list())

    def to_pandas(self, /, **filters: Unpack[TrialFilters]) -> Any:
        """The stored trials as a DataFrame (extra ``pandas``); filters as in :meth:`list`."""
        return self.list(**filters).to_pandas()


class Batches(Resource):
    """``mug.batches``: what arrived together and can be deleted together."""

    def list(self, *, licence: str | None = None) -> Listing[wire.BatchInfo]:
        """All batches, or those under a licence, read page by page."""
        params = {} if licence is None else {"licence": licence}
        return Listing(self._transport, self._path, wire.BatchInfo, params)

    def __iter__(self) -> Iterator[wire.BatchInfo]:
        return iter(self.list())

    def get(self, batch: str) -> wire.BatchInfo:
        """One batch."""
        return self._transport.model(wire.BatchInfo, "GET", f"{self._path}/{segment(batch)}")

    def delete(self, batch: str) -> None:
        """Delete a batch with all its trials (and, a sweep's, its packed outcomes)."""
        self._transport.request("DELETE", f"{self._path}/{segment(batch)}")


def _broken_off(
    error: BaseException,
    receipts: Sequence[wire.BatchReceipt],
    rows: tuple[int, int],
    key: str,
    way_on: str | None,
) -> Iterator[str]:
    """What is stored of an upload that broke off at a request with trials of these ``rows``, and how to go
    on.
    """
    start, stop = rows
    refused = isinstance(error, GraspDBError) and error.status is not None and error.status < 500
    if receipts:
        request = f"This was the request with trials {start} to {stop - 1}"
        if isinstance(error, InvalidInput):
            request += f": indices above count from {start}"
        batches = ", ".join(receipt.batch for receipt in receipts)
        yield (f"{request}. " if stop > start else "") + (
            f"The {start} trials before are stored, in batches {batches}."
        )
    elif refused or stop == start:
        return
    if stop > start and not refused:
        yield f"Whether trials {start} to {stop - 1} are stored, too, is not known."
    yield way_on or (
        f"To go on, send all of it again with idempotency_key={key} and the same chunk: nothing is stored"
        " twice."
    )


def _plain(values: Any) -> Any:
    """An array as lists, NaN as None."""
    if isinstance(values, Mapping):
        return {name: _plain(column) for name, column in values.items()}
    if isinstance(values, np.ndarray) and values.dtype.kind == "f" and values.ndim == 1:
        return [None if x != x else x for x in values.tolist()]
    return values.tolist() if isinstance(values, np.ndarray) else values


def _from_row(finding: wire.Finding, start: int) -> wire.Finding:
    """A finding of the request whose first trial is the upload's number ``start``."""
    return finding.model_copy(update={"first_indices": [start + index for index in finding.first_indices]})


def _times(times: Any, count: int) -> list[str | None]:
    """Times as text, a value a trial; NumPy's and pandas' too, whose missing ones are None."""
    if getattr(getattr(times, "dtype", None), "kind", None) == "M":
        utc = listed("measured_at", np.asarray(times, dtype="datetime64[us]"), count)
        return [None if time is None else time.replace(tzinfo=timezone.utc).isoformat() for time in utc]
    each = _each("measured_at", times, datetime, count)
    # A missing time of pandas is one that differs from itself.
    return [None if time is None or time != time else time.isoformat() for time in each]


def _outcomes(outcomes: ArrayLike | str | bool, count: int) -> list[Any]:
    if (row := first_masked(outcomes)) is not None:
        raise ValueError(f"outcome {row} is masked: leave it out")
    values = listed("outcomes", np.asarray(outcomes), count)
    for index, value in enumerate(values):
        if not isinstance(value, bool) and value not in wire.OUTCOME_CODES:
            raise ValueError(
                f"outcome {index} is {value!r}; expected a bool or one of {', '.join(wire.OUTCOMES)}"
            )
    return values


def _achieved(poses: Any, count: int) -> list[Any]:
    """A pose a trial as requests take it, None where it is unknown."""
    unknown = [False] * count
    if isinstance(poses, (list, tuple)) and any(pose is None for pose in poses):
        unknown = [pose is None for pose in poses]
        poses = [pose for pose in poses if pose is not None]
        if not poses:
            return [None] * count
    given = as_poses(poses)
    if len(unknown) != count or len(given.position) != count - sum(unknown):
        raise ValueError(f"achieved_poses has {len(given.position)} poses for {count} trials")
    rows = zip(given.position.tolist(), given.quaternion_xyzw.tolist(), strict=True)
    known = ({"position": position, "quaternion_xyzw": quaternion} for position, quaternion in rows)
    return [None if missing else next(known) for missing in unknown]


def _whole(number: float | None) -> float | int | None:
    """A whole number as one; what is none is left for the service to name."""
    return int(number) if number is not None and number.is_integer() else number


def _each(name: str, values: Any, kind: type[Any], count: int) -> list[Any]:
    """A value a trial; one goes for all."""
    each = [values] * count if isinstance(values, kind) else list(values)
    if len(each) != count:
        raise ValueError(f"{name} has {len(each)} entries for {count} poses")
    return each


@contextmanager
def _upload_bar(progress: bool | ProgressCallback) -> Iterator[ProgressCallback]:
    """On stderr, so that stdout stays clean for data."""
    if callable(progress):
        yield progress
        return
    bar = Progress(
        TextColumn("upload"), BarColumn(), MofNCompleteColumn(), TextColumn("trials"), TimeRemainingColumn(),
        console=Console(stderr=True), disable=not progress,
    )  # fmt: skip
    task = bar.add_task("upload", total=None)
    with bar:
        yield lambda done, total: bar.update(task, completed=done, total=total)
