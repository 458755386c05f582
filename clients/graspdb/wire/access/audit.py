"""The audit: what was changed, and which key did it."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from graspdb.wire.base import Response

AuditAction = Literal[
    "object.create",
    "object.copy",
    "object.change",
    "object.delete",
    "mesh.put",
    "parts.put",
    "batch.create",
    "batch.delete",
    "trial.correct",
    "trial.withdraw",
    "sweep.create",
    "sweep.cancel",
    "sweep.retry",
    "job.result",
    "gripper.create",
    "gripper.change",
    "gripper.delete",
    "robot.put",
    "robot.change",
    "robot.delete",
    "scene.put",
    "scene.delete",
    "kernel.create",
    "kernel.delete",
    "answer.delete",
    "database.restore",
    "database.repair",
    "key.create",
    "key.rotate",
    "key.revoke",
]
"""A change that the audit records."""


class AuditEntry(Response):
    """A change, and which key made it."""

    id: int
    """Number of the entry; later ones have higher numbers."""
    at: datetime
    """When it was made, UTC."""
    action: str
    """What was done, such as ``batch.create``."""
    key: str | None = None
    """Name of the key that did it; null where keys were off, or the service did it by itself."""
    key_id: str | None = None
    """Id of that key; null as for its name."""
    object: str | None = None
    """Id of the object whose it was; null where it was no object's."""
    subject: str | None = None
    """Id of the batch, sweep, job, gripper, kernel or key, or a trial's number; null where the object itself
    was changed."""
    request_id: str | None = None
    """Finds the request in the service's log; null where it was no request."""
