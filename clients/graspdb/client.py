"""The synchronous client: ``with Client("http://127.0.0.1:8000") as db: ...``."""

from __future__ import annotations

from typing import Any

from graspdb import wire
from graspdb.errors import GraspDBError
from graspdb.examples import example
from graspdb.reports import AllReports
from graspdb.resources.access.audit import Audit
from graspdb.resources.access.keys import Keys
from graspdb.resources.answers import Answers
from graspdb.resources.cells.robots import Robots
from graspdb.resources.cells.scenes import Scenes
from graspdb.resources.grippers import Grippers
from graspdb.resources.kernels import Kernels
from graspdb.resources.objects import GraspObject, Objects
from graspdb.resources.pages import Listing
from graspdb.resources.results import table_html
from graspdb.resources.sweeps import Sweeps
from graspdb.transport import Transport


class Client:
    """A connection to a GraspDB service; safe to share between threads.

    ``url`` is by default ``$GRASPDB_URL``, else ``http://127.0.0.1:8000``; ``api_key`` ``$GRASPDB_API_KEY``.
    ``timeout_s`` is per attempt; a request that computes much may take as long. ``retries`` are attempts
    after the first, on connection errors, timeouts and 429, 502, 503, 504.
    """

    def __init__(
        self,
        url: str | None = None,
        *,
        api_key: str | None = None,
        timeout_s: float = 120.0,
        retries: int = 5,
    ) -> None:
        self._transport = Transport(
            url, api_key=api_key, timeout_s=timeout_s, retries=retries, user_agent="graspdb-python"
        )
        self.objects = Objects(self._transport, "/objects")
        self.grippers = Grippers(self._transport, "/grippers")
        self.robots = Robots(self._transport, "/robots")
        self.scenes = Scenes(self._transport, "/scenes")
        self.kernels = Kernels(self._transport, "/kernels")
        self.answers = Answers(self._transport, "/answers")
        self.reports = AllReports(self._transport, "/reports")
        self.sweeps = Sweeps(self._transport, "/sweeps")
        self.keys = Keys(self._transport, "/keys")
        self.audit = Audit(self._transport, "/audit")

    @property
    def url(self) -> str:
        """The service's base address."""
        return self._transport.url

    def info(self) -> dict[str, Any]:
        """The service's versions and limits."""
        answer: dict[str, Any] = self._transport.json("GET", "/info")
        return answer

    def ready(self) -> bool:
        """True if the service answers and can reach its database; asked once, without retries."""
        try:
            return self._transport.request("GET", "/readyz", retries=0).is_success
        except GraspDBError:
            return False

    def workers(self) -> list[wire.WorkerInfo]:
        """The simulation workers that have asked for jobs."""
        return list(Listing(self._transport, "/workers", wire.WorkerInfo))

    def add_example(self, name: str) -> GraspObject:
        """Create one of the paper's objects: ``cone``, ``elongated-d``, ``screwdriver`` or ``mug``.

        With its mesh, its convex parts, mass and friction. Needs trimesh (extra ``examples``).
        """
        model = example(name)
        try:
            parts = model.parts_glb()
        except ImportError as error:
            raise ImportError("the examples need trimesh: pip install 'graspdb[examples]'") from error
        return self.objects.create(
            model.name,
            name=model.title,
            mesh=model.stl(),
            unit="m",
            media_type="model/stl",
            convex_parts=parts,
            mass_kg=model.mass_kg,
            friction=model.friction,
        )

    def close(self) -> None:
        """Close the connections."""
        self._transport.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Client({self.url!r})"

    def _repr_html_(self) -> str:
        return table_html("GraspDB", {"url": self.url, **self.info()})
