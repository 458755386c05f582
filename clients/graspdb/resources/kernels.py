"""Stored kernels: fitted on an object's trials or given by their components."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from graspdb import wire
from graspdb.resources.pages import Listing, checked, segment
from graspdb.resources.runs import RunProgress, finished
from graspdb.transport import Transport

__all__ = ["Kernels"]


class Kernels:
    """``db.kernels``: queries take a kernel's id, or ``anisotropic`` for the newest, as ``kernel``."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def fit(
        self,
        /,
        object: str,
        *,
        progress: RunProgress | None = None,
        timeout_s: float | None = None,
        **options: Any,
    ) -> wire.StoredKernel:
        """Fit a kernel on an object's successes, or with ``kind="probability"`` on all its attempts.

        Waits until it is fitted. ``components="auto"`` may take a while: ``progress`` is called with its run
        meanwhile, and ``timeout_s`` ends the wait, not the fit: the kernel is in the list once it is done.

        Options are those of :class:`graspdb.wire.KernelCreate`: ``kind``, ``gripper``, ``alignment``,
        ``components`` (how many Gaussians, or ``auto``), ``window``, ``component_widths``, ``protocol``,
        ``source``.

        Raises
        ------
        Conflict
            For too few trials, saying how many are needed.
        """
        return self._create({"object": object, **options}, progress, timeout_s)

    def create(self, /, components: list[Any], **options: Any) -> wire.StoredKernel:
        """Store a kernel given by its components: ``weight``, ``mean`` (6), ``covariance`` (6, 6)."""
        return self._create({"components": components, **options})

    def get(self, id: str) -> wire.StoredKernel:
        """The kernel with this id."""
        return wire.StoredKernel.model_validate(self._transport.json("GET", f"/kernels/{segment(id)}"))

    def list(self) -> Iterator[wire.StoredKernel]:
        """All kernels, oldest first."""
        return iter(Listing(self._transport, "/kernels", wire.StoredKernel))

    def __iter__(self) -> Iterator[wire.StoredKernel]:
        return self.list()

    def delete(self, id: str) -> None:
        """Delete a kernel."""
        self._transport.request("DELETE", f"/kernels/{segment(id)}")

    def _create(
        self, fields: dict[str, Any], progress: RunProgress | None = None, timeout_s: float | None = None
    ) -> wire.StoredKernel:
        request = checked(wire.KernelCreate, fields)
        answer = self._transport.request("POST", "/kernels", body=request, idempotent=True)
        made = answer.json()
        if answer.status_code == 202:
            where = answer.headers["Location"]
            made = finished(self._transport, where, "the kernel", progress, timeout_s)
        return wire.StoredKernel.model_validate(made)
