"""Scenes: what stands around, stored once, so that questions name it."""

from __future__ import annotations

import hashlib

import orjson

from graspdb.wire import SceneCreate, SceneInfo, SceneSummary
from graspdb_service import principal
from graspdb_service.problems import conflict, found, invalid, invalid_fields
from graspdb_service.storage import objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.cells import scenes
from graspdb_service.storage.cells.scenes import SceneRow
from graspdb_service.storage.database import Database, Tx
from graspdb_service.usecases.cells.standing import StandingScene
from graspdb_service.usecases.identifiers import is_slug

_LIST = "GET /scenes lists them, PUT /scenes/{id} stores one"


def put(database: Database, id: str, scene: SceneCreate) -> tuple[SceneSummary, bool]:
    """Store a scene under an id, in place of the one before; whether it is a new one. 422 for objects in it
    that are not there, or have no mesh.
    """
    principal.refuse_limited("Scenes")
    if not is_slug(id):
        raise invalid("id", "letters, digits, '.', '_' and '-', at most 64, the first a letter or digit")
    content = orjson.dumps(scene.model_dump(mode="json"))
    summary = {
        "boxes": len(scene.boxes),
        "points": len(scene.points),
        "objects": [item.object for item in scene.objects],
    }
    with database.write() as tx:
        errors = []
        for i, item in enumerate(scene.objects):
            standing_there = objects.find(tx, item.object)
            if standing_there is None or standing_there.mesh_sha256 is None:
                told = "it has no mesh: PUT one first" if standing_there else "there is no such object"
                errors.append((f"objects.{i}.object", told))
        if errors:
            raise invalid_fields(errors)
        new = scenes.find(tx, id) is None
        scenes.put(tx, id, sha256=hashlib.sha256(content).hexdigest(), content=content, summary=summary)
        audit.record(tx, "scene.put", subject=id)
        row = _require(tx, id)
    return _summary(row), new


def get(database: Database, id: str) -> SceneInfo:
    """One scene with all that stands in it."""
    with database.read() as tx:
        row = _require(tx, id)
        content = scenes.content(tx, id)
    assert content is not None
    return SceneInfo.model_validate({**vars(row), "scene": orjson.loads(content)})


def standing(database: Database, id: str) -> StandingScene:
    """The scene that a question names, 404 where there is none, and 409 where an object in it is gone."""
    with database.read() as tx:
        row = _require(tx, id)
        content = scenes.content(tx, id)
        rows = {name: objects.find(tx, name) for name in row.summary["objects"]}
    assert content is not None
    there = {name: found for name, found in rows.items() if found is not None and found.mesh_sha256}
    gone = [name for name in rows if name not in there]
    if gone:
        told = f"Scene {id!r} has objects in it that are gone or have no mesh: {', '.join(gone)}; PUT it anew"
        raise conflict("scene-outdated", told)
    # It was checked when it was stored.
    stamp = " ".join([row.sha256, *(f"{found.id}:{found.revision}" for found in there.values())])
    return StandingScene(SceneCreate.model_validate(orjson.loads(content)), stamp, there)


def page(database: Database, *, after: str, limit: int) -> tuple[list[SceneSummary], str | None]:
    """A page of scenes by id, and where the next one starts."""
    with database.read() as tx:
        rows = scenes.page(tx, after=after, limit=limit + 1)
    # A key that sees some objects only gets short pages.
    items = [_summary(row) for row in rows[:limit] if _seen(row)]
    return items, rows[limit - 1].id if len(rows) > limit else None


def remove(database: Database, id: str) -> None:
    """Delete a scene; questions that name it are answered 404 from then on."""
    principal.refuse_limited("Scenes")
    with database.write() as tx:
        _require(tx, id)
        scenes.remove(tx, id)
        audit.record(tx, "scene.delete", subject=id)


def _require(tx: Tx, id: str) -> SceneRow:
    """The scene, or a 404: its id does not tell whose objects are in it."""
    row = scenes.find(tx, id) if is_slug(id) else None
    return found(row if row is not None and _seen(row) else None, "scene", id, _LIST)


def _seen(row: SceneRow) -> bool:
    return all(principal.sees(name) for name in row.summary["objects"])


def _summary(row: SceneRow) -> SceneSummary:
    return SceneSummary.model_validate({**vars(row), **row.summary})
