"""``graspdb scenes``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from graspdb.cli.common import State
from graspdb.cli.options import Commands

scenes = Commands(
    no_args_is_help=True, help="Store, list, show and delete scenes: what stands around the gripper."
)

SceneId = Annotated[str, typer.Argument(help="Id of the scene.", show_default=False)]


@scenes.command("put")
def put_scene(
    state: State,
    id: SceneId,
    file: Annotated[
        Path, typer.Argument(help="JSON file with boxes, points and objects, as `scenes show` prints it.")
    ],
) -> None:
    """Store a scene, or replace it, in the world's frame."""
    try:
        given: Any = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file} is no JSON: {error}") from None
    if not isinstance(given, dict):
        raise ValueError(f"{file} holds no JSON object")
    fields = dict(given.get("scene", given))
    fields["objects"] = [(item["object"], item["pose"]) for item in fields.get("objects", ())]
    stored = state.db.scenes.put(id, **fields)
    told = f"{stored.boxes} boxes, {stored.points} points, {len(stored.objects)} objects"
    state.show(stored, f"Scene {stored.id} is stored: {told}.")


@scenes.command("list")
def list_scenes(state: State) -> None:
    """List the scenes."""
    state.show_list(
        list(state.db.scenes),
        {
            "id": lambda scene: scene.id,
            "boxes": lambda scene: scene.boxes,
            "points": lambda scene: scene.points,
            "objects": lambda scene: ", ".join(scene.objects),
        },
        empty="No scenes.",
    )


@scenes.command("show")
def show_scene(state: State, id: SceneId) -> None:
    """Show a scene: the JSON file that `scenes put` takes."""
    found = state.db.scenes.get(id)
    state.show(found, json.dumps(found.scene.model_dump(mode="json"), indent=2))


@scenes.command("delete")
def delete_scene(state: State, id: SceneId) -> None:
    """Delete a scene."""
    state.db.scenes.delete(id)
    state.show({"deleted": id}, f"{id} is deleted.")
