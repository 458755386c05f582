"""An object's trials and batches from the client's side: add them, page through them, delete them."""

from __future__ import annotations

import builtins
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from graspdb import wire
from graspdb.errors import GraspDBError
from graspdb.poses import as_poses
from graspdb.resources.pages import Listing, segment
from graspdb.results import TrialArrays
from graspdb.transport import Transport

__all__ = ["CHUNK_TRIALS", "Batches", "Receipt", "TrialListing", "Trials"]

CHUNK_TRIALS = 50_000
"""Trials a request: some 10 MB of JSON, well under the service's default body limit."""

ProgressCallback = Callable[[int, int], None]
"""Called with the trials stored so far and their total."""


@dataclass(frozen=True)
class Receipt:
    """What an upload stored: its batches (one a request), the number of trials, the object's revision."""

    batches: tuple[str, ...]
    inserted: int
    revision: int

    @property
    def batch(self) -> str:
        """The batch, where the upload fitted into one."""
        if len(self.batches) != 1:
            raise ValueError(f"this upload went into {len(self.batches)} batches: see .batches")
        return self.batches[0]


class TrialListing(Listing[wire.TrialOut]):
    """Stored trials in commit order; iterate, or read them all as arrays."""

    def arrays(self) -> TrialArrays:
        """All of them as columns."""
        return TrialArrays.of(tuple(self))

    def to_pandas(self) -> Any:
        """All of them as a DataFrame (extra ``pandas``)."""
        return self.arrays().to_pandas()


class Trials:
    """``mug.trials``: the trials of one object."""

    def __init__(self, transport: Transport, object_id: str) -> None:
        self._transport = transport
        self._path = f"/objects/{segment(object_id)}/trials"

    def add(
        self,
        poses: ArrayLike | Any,
        outcomes: ArrayLike | str | bool,
        *,
        gripper: str | None = None,
        source: str | None = None,
        protocol: str | None = None,
        proposal_density: ArrayLike | None = None,
        quality: ArrayLike | None = None,
        width_m: ArrayLike | None = None,
        pose_covariance: ArrayLike | None = None,
        measured_at: datetime | Sequence[datetime | None] | None = None,
        metadata: Mapping[str, Any] | Sequence[Mapping[str, Any] | None] | None = None,
        chunk: int = CHUNK_TRIALS,
        idempotency_key: str | None = None,
        progress: bool | ProgressCallback = False,
    ) -> Receipt:
        """Store grasp trials.

        Parameters
        ----------
        poses
            Tool frames in the object frame: (N, 4, 4) matrices or (N, 7) rows x y z qx qy qz qw, or one
            pose; a :class:`~graspdb.results.Grasp` or samples are taken too.
        outcomes
            (N,) booleans or outcome names; a single one goes for all poses.
        gripper, source, protocol
            Of the whole upload.
        proposal_density
            1/(m^3 rad^3), (N,) or one number: the density the poses were drawn from.
        quality, width_m
            (N,) or one number; NaN where unknown. Width is the jaw's opening in metres.
        pose_covariance
            (6, 6) or (N, 6, 6), translation first, tool frame.
        measured_at, metadata
            One for all, or a sequence with one a trial.
        chunk
            Trials a request. Each request is stored wholly or not at all and is its own batch.
        idempotency_key
            Repeat a failed upload with the same key, data and ``chunk``, and nothing is stored twice.
        progress
            True shows a bar; a function is called with trials stored and total.

        Raises
        ------
        ValueError
            If shapes or poses are wrong: nothing was sent.
        InvalidInput
            If the service refuses the trials; the message names the trial and field.
        """
        position, quaternion = as_poses(poses)
        count = len(position)
        columns: dict[str, list[Any]] = {
            "position": position.tolist(),
            "quaternion_xyzw": quaternion.tolist(),
            "outcome": _outcomes(outcomes, count),
        }
        for name, values in (
            ("proposal_density", proposal_density),
            ("quality", quality),
            ("width_m", width_m),
        ):
            if values is not None:
                columns[name] = _numbers(name, values, count)
        if pose_covariance is not None:
            covariance = np.asarray(pose_covariance, dtype=np.float64)
            if covariance.shape not in {(6, 6), (count, 6, 6)}:
                raise ValueError(
                    f"pose_covariance has shape {covariance.shape}; expected (6, 6) or ({count}, 6, 6)"
                )
            columns["pose_covariance"] = np.broadcast_to(covariance, (count, 6, 6)).tolist()
        if measured_at is not None:
            times = [measured_at] * count if isinstance(measured_at, datetime) else builtins.list(measured_at)
            columns["measured_at"] = [
                None if t is None else t.isoformat() for t in _exactly("measured_at", times, count)
            ]
        shared: dict[str, Any] = {"gripper": gripper, "source": source, "protocol": protocol}
        if isinstance(metadata, Mapping):
            shared["metadata"] = dict(metadata)
        elif metadata is not None:
            columns["metadata"] = _exactly("metadata", builtins.list(metadata), count)
        shared = {name: value for name, value in shared.items() if value is not None}

        def body(start: int, stop: int) -> dict[str, Any]:
            return {**shared, "columns": {name: values[start:stop] for name, values in columns.items()}}

        return self._send(body, count, chunk, idempotency_key, progress)

    def add_records(
        self,
        /,
        records: Iterable[Mapping[str, Any]],
        *,
        chunk: int = CHUNK_TRIALS,
        idempotency_key: str | None = None,
        progress: bool | ProgressCallback = False,
        **shared: Any,
    ) -> Receipt:
        """Store trials given as mappings with the fields of the HTTP interface.

        ``shared`` stands once for all that do not say it themselves: ``gripper``, ``source``, ``protocol``,
        ``proposal_density``, ``metadata``. The other parameters and errors are those of :meth:`add`.
        """
        trials = [dict(record) for record in records]
        if not trials:
            raise ValueError("give at least one trial")
        shared = {name: value for name, value in shared.items() if value is not None}
        return self._send(
            lambda start, stop: {**shared, "trials": trials[start:stop]},
            len(trials),
            chunk,
            idempotency_key,
            progress,
        )

    def _send(
        self,
        body: Callable[[int, int], dict[str, Any]],
        count: int,
        chunk: int,
        idempotency_key: str | None,
        progress: bool | ProgressCallback,
    ) -> Receipt:
        if chunk < 1:
            raise ValueError("chunk must be at least 1")
        key = idempotency_key or str(uuid.uuid4())
        receipts: list[wire.BatchReceipt] = []
        with _upload_bar(progress) as report:
            for number, start in enumerate(range(0, count, chunk)):
                stop = min(start + chunk, count)
                try:
                    answer = self._transport.json(
                        "POST",
                        self._path,
                        body=body(start, stop),
                        idempotency_key=key if count <= chunk else f"{key}-{number}",
                    )
                except GraspDBError as error:
                    if start:
                        error.add_note(
                            f"This was the request with trials {start} to {stop - 1}: indices above count"
                            f" from {start}. The {start} trials before are stored, in batches"
                            f" {', '.join(r.batch for r in receipts)}."
                        )
                    raise
                receipts.append(wire.BatchReceipt.model_validate(answer))
                report(stop, count)
        return Receipt(
            batches=tuple(receipt.batch for receipt in receipts),
            inserted=sum(receipt.inserted for receipt in receipts),
            revision=receipts[-1].revision,
        )

    def list(
        self,
        *,
        outcome: str | None = None,
        source: str | None = None,
        gripper: str | None = None,
        protocol: str | None = None,
        batch: str | None = None,
        since_revision: int | None = None,
    ) -> TrialListing:
        """The stored trials that match, read page by page as they are iterated."""
        params = {
            "outcome": outcome,
            "source": source,
            "gripper": gripper,
            "protocol": protocol,
            "batch": batch,
            "since_revision": since_revision,
        }
        return TrialListing(self._transport, self._path, wire.TrialOut, params)

    def __iter__(self) -> Iterator[wire.TrialOut]:
        return iter(self.list())

    def to_pandas(self, /, **filters: Any) -> Any:
        """The stored trials as a DataFrame (extra ``pandas``); filters as in :meth:`list`."""
        return self.list(**filters).to_pandas()


class Batches:
    """``mug.batches``: what arrived together and can be deleted together."""

    def __init__(self, transport: Transport, object_id: str) -> None:
        self._transport = transport
        self._path = f"/objects/{segment(object_id)}/batches"

    def list(self) -> Listing[wire.BatchInfo]:
        """All batches, read page by page."""
        return Listing(self._transport, self._path, wire.BatchInfo)

    def __iter__(self) -> Iterator[wire.BatchInfo]:
        return iter(self.list())

    def get(self, batch: str) -> wire.BatchInfo:
        """One batch."""
        return wire.BatchInfo.model_validate(self._transport.json("GET", f"{self._path}/{segment(batch)}"))

    def delete(self, batch: str) -> None:
        """Delete a batch with all its trials (and, a sweep's, its packed outcomes)."""
        self._transport.request("DELETE", f"{self._path}/{segment(batch)}")


def _outcomes(outcomes: ArrayLike | str | bool, count: int) -> list[Any]:
    array: NDArray[Any] = np.asarray(outcomes)
    if array.ndim == 0:
        array = np.broadcast_to(array, (count,))
    if array.shape != (count,):
        raise ValueError(f"outcomes have shape {array.shape}; expected ({count},), one a pose")
    values: list[Any] = array.tolist()
    for index, value in enumerate(values):
        if not isinstance(value, bool) and value not in wire.OUTCOME_CODES:
            raise ValueError(
                f"outcome {index} is {value!r}; expected a bool or one of {', '.join(wire.OUTCOMES)}"
            )
    return values


def _numbers(name: str, values: ArrayLike, count: int) -> list[float | None]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape not in {(), (count,)}:
        raise ValueError(f"{name} has shape {array.shape}; expected ({count},) or one number")
    return [None if np.isnan(value) else value for value in np.broadcast_to(array, (count,)).tolist()]


def _exactly(name: str, values: list[Any], count: int) -> list[Any]:
    if len(values) != count:
        raise ValueError(f"{name} has {len(values)} entries for {count} poses")
    return values


def _upload_bar(progress: bool | ProgressCallback) -> AbstractContextManager[ProgressCallback]:
    if callable(progress):
        return nullcontext(progress)
    return _UploadBar() if progress else nullcontext(lambda _done, _total: None)


class _UploadBar(AbstractContextManager[ProgressCallback]):
    """On stderr, so that stdout stays clean for data."""

    def __init__(self) -> None:
        self._bar = Progress(
            TextColumn("upload"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("trials"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._task = self._bar.add_task("upload", total=None)

    def __enter__(self) -> ProgressCallback:
        self._bar.start()
        return lambda done, total: self._bar.update(self._task, completed=done, total=total)

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
