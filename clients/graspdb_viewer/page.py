"""What the panels of one page share: the browser, the service, the view, and the object that is shown."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from graspdb import Client
from graspdb.errors import (
    AmbiguousSelection,
    AuthenticationError,
    GraspDBError,
    NotFound,
    PermissionDenied,
    Unreachable,
)
from graspdb.poses import Poses
from graspdb.resources.objects import GraspObject
from graspdb.resources.selection import TrialSelection
from graspdb.wire import DensityInfo, GripperProfile
from graspdb_viewer.scene.shapes import Shape
from graspdb_viewer.view import View

Floats = NDArray[np.float64]
OBJECT = "/object"
"""The node of the object frame: what lies below it moves with the object."""


@dataclass
class Subject:
    """The object that is shown: ``size_m`` is its diagonal, ``centre`` (3,) of its box in its own frame.

    ``selection`` names the trials' gripper and protocol where the object has several; ``profile`` is of
    ``gripper``, the version that the trials were made with; ``density`` is None before any trial.
    """

    item: GraspObject
    mesh: Shape | None
    size_m: float
    centre: Floats
    selection: TrialSelection
    gripper: str | None = None
    profile: GripperProfile | None = None
    density: DensityInfo | None = None

    @property
    def successes(self) -> int:
        """How many successes the density is made of."""
        return 0 if self.density is None else self.density.size


@dataclass
class Page:
    """One browser's page; ``say`` shows a line at the top of it, None nothing."""

    client: viser.ClientHandle
    db: Client
    view: View
    say: Callable[[str | None], None]
    subject: Subject | None = None
    nodes: dict[str, Any] = field(default_factory=dict)

    def replace(self, name: str, node: Any | None) -> None:
        """Keep a scene node under a name in place of the one before, which goes; None: there is none."""
        # viser takes a node off that is added again under its own path.
        before = self.nodes.pop(name, None)
        if before is not None and (node is None or before.name != node.name):
            before.remove()
        if node is not None:
            self.nodes[name] = node

    def failed(self, error: Exception) -> None:
        """Say what went wrong, and the way out."""
        self.say(in_words(error, self.db.url))

    def instances(self, path: str, shape: Shape, poses: Poses, colours: Any, **options: Any) -> Any:
        """One shape at every pose."""
        return self.client.scene.add_batched_meshes_simple(
            path,
            shape.vertices,
            shape.faces,
            batched_wxyzs=wxyz(poses.quaternion_xyzw),
            batched_positions=poses.position,
            batched_colors=_linear(colours),
            flat_shading=True,
            cast_shadow=False,
            receive_shadow=False,
            **options,
        )

    def solid(self, path: str, shape: Shape, colour: tuple[int, int, int], **options: Any) -> Any:
        """One shape."""
        options = {"flat_shading": True, "cast_shadow": False, "receive_shadow": False, **options}
        return self.client.scene.add_mesh_simple(path, shape.vertices, shape.faces, color=colour, **options)


def _linear(colours: Any) -> NDArray[np.uint8]:
    """Colours (n, 3) or (3,) by their light, as viser takes those of instances, and those alone."""
    return np.rint(255.0 * (np.asarray(colours) / 255.0) ** 2.2).astype(np.uint8)


def put(control: Any, value: Any) -> None:
    """Show a value in a control, whose own type says that it can only be read."""
    control.value = value


def in_words(error: Exception, url: str) -> str:
    """An error as the page says it: what is wrong and what to do."""
    if isinstance(error, Unreachable):
        return (
            f"**The service does not answer** at `{url}`. Start it with `graspdb-server serve`, or open the"
            " viewer with the right `--url`; then press *Again*."
        )
    if isinstance(error, AuthenticationError):
        return (
            f"**The service at `{url}` does not take this key.** Open the viewer with one that has the scope"
            " `read`: `graspdb --api-key KEY view`, or set `GRASPDB_API_KEY`."
        )
    if isinstance(error, PermissionDenied):
        return f"**The viewer's key does not allow this.** {error}"
    if isinstance(error, AmbiguousSelection):
        return "**This object was tried with several grippers or protocols.** Choose one of each above."
    if isinstance(error, NotFound):
        return f"**Not there.** {error}"
    if isinstance(error, (GraspDBError, ValueError, ImportError)):
        return str(error)
    return f"**The viewer failed**, which is a bug: {type(error).__name__}: {error}"


def wxyz(quaternion_xyzw: ArrayLike) -> Floats:
    """Quaternions as viser has them, the real part first."""
    return np.roll(np.asarray(quaternion_xyzw, dtype=np.float64), 1, axis=-1)


def xyzw(quaternion_wxyz: ArrayLike) -> tuple[float, float, float, float]:
    """A quaternion of viser's as ours, of unit length."""
    w, x, y, z = np.asarray(quaternion_wxyz, dtype=np.float64).tolist()
    norm = math.sqrt(x * x + y * y + z * z + w * w) or 1.0
    return (x / norm, y / norm, z / norm, w / norm)


def triple(values: ArrayLike) -> tuple[float, float, float]:
    """Three numbers, as a view has them."""
    x, y, z = np.asarray(values, dtype=np.float64).tolist()
    return (x, y, z)
