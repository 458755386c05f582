"""Stored kernels: fitted on an object's trials or given by their components."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from typing_extensions import Unpack

from graspdb import wire
from graspdb.options import Option
from graspdb.resources.pages import Listing, Resource, segment, validate
from graspdb.resources.runs import RunProgress, computed
from graspdb.resources.selection import TrialSelection


class KernelOptions(TrialSelection, total=False):
    """The trials a kernel is fitted on, and the fields of :class:`graspdb.wire.KernelCreate` that say how."""

    alignment: Annotated[
        str,
        Option(
            "gripper; anisotropic: or object, edge, surface-pair; probability: or object.", default="gripper"
        ),
    ]
    components: Annotated[
        int | str | None,
        Option("anisotropic: 1 to 16 Gaussians, or auto; sampled: displacements."),
    ]
    kind: Annotated[str, Option("anisotropic, sampled or probability.", default="anisotropic")]
    window: wire.KernelWindow | Mapping[str, float] | None
    component_widths: wire.KernelWidths | Mapping[str, float] | None


class Kernels(Resource):
    """``db.kernels``: queries take a kernel's id, or ``anisotropic`` for the newest, as ``kernel``."""

    def fit(
        self,
        /,
        object: str,
        *,
        progress: RunProgress | None = None,
        timeout_s: float | None = None,
        **options: Unpack[KernelOptions],
    ) -> wire.StoredKernel:
        """Fit a kernel on an object's successes, with ``kind="probability"`` on all attempts; waits for it.

        ``components="auto"`` may take a while: ``progress`` is called with its run meanwhile, and
        ``timeout_s`` ends the wait, not the fit. Conflict says how many trials are needed where they are too
        few.
        """
        return self._create({"object": object, **options}, progress, timeout_s)

    def create(self, /, components: list[Any], **options: Any) -> wire.StoredKernel:
        """Store a kernel given by its components: ``weight``, ``mean`` (6), ``covariance`` (6, 6)."""
        return self._create({"components": components, **options})

    def get(self, id: str) -> wire.StoredKernel:
        """The kernel with this id."""
        return self._transport.model(wire.StoredKernel, "GET", f"{self._path}/{segment(id)}")

    def list(self) -> Iterator[wire.StoredKernel]:
        """All kernels, oldest first."""
        return iter(Listing(self._transport, self._path, wire.StoredKernel))

    def __iter__(self) -> Iterator[wire.StoredKernel]:
        return self.list()

    def delete(self, id: str) -> None:
        """Delete a kernel."""
        self._transport.request("DELETE", f"{self._path}/{segment(id)}")

    def _create(
        self, fields: dict[str, Any], progress: RunProgress | None = None, timeout_s: float | None = None
    ) -> wire.StoredKernel:
        request = validate(wire.KernelCreate, fields)
        answer = self._transport.request("POST", self._path, body=request, idempotent=True)
        made = computed(self._transport, answer, "the kernel", progress, timeout_s)
        return wire.StoredKernel.model_validate(made)
