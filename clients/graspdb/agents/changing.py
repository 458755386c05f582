"""What agents may change, where whoever started the server allows it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from pydantic import Field

from graspdb import wire
from graspdb.agents.asking import Axes, Object
from graspdb.resources.pages import segment
from graspdb.transport import Transport


class Changes:
    """The tools that write: they add, and none of them takes away."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def tools(self) -> tuple[Callable[..., Any], ...]:
        """Each as a server takes it: docstring and annotations are what agents read."""
        return self.add_trials, self.start_sweep

    def add_trials(
        self,
        object: Object,
        trials: wire.TrialsIn,
        key: Annotated[
            str,
            Field(
                pattern=r"^[!-~]{8,200}$",
                description="A UUID, or any name without spaces: sent again under the"
                " same, it is stored once.",
            ),
        ],
        frame: Annotated[str, Field(description="The gripper's frame that the poses are of.")] = "tool",
        convention: Axes = "graspdb",
    ) -> dict[str, Any]:
        """Store what was tried as one batch: the pose of the gripper's frame in the object, and its outcome.

        Read `findings` in the answer: they tell what looks wrong. A batch that was a mistake is deleted by a
        person.
        """
        path = f"/objects/{segment(object)}/trials"
        asked = (
            {"frame": frame, "convention": convention} if (frame, convention) != ("tool", "graspdb") else {}
        )
        found: dict[str, Any] = self._transport.json(
            "POST", path, params=asked, body=trials, idempotency_key=key
        )
        return found

    def start_sweep(self, object: Object, sweep: wire.SweepCreate) -> dict[str, Any]:
        """Have workers simulate grasps of an object: a grid, given poses, or draws from its density."""
        path = f"/objects/{segment(object)}/sweeps"
        found: dict[str, Any] = self._transport.json("POST", path, body=sweep, idempotent=True)
        return found
