"""Widths that rows of an object have chosen, known by what those rows are."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import delete, select

from graspdb_service.storage.database import Tx, first_as, insert_or
from graspdb_service.storage.tables import objects, width_choices

#: Choices kept of an object: one for each doubling of its rows, selection and correction, and no more of old.
_MOST = 64


@dataclass(frozen=True)
class ChosenWidths:
    """Standard deviations in metres and radians, and the rule that chose them."""

    sigma_position_m: float
    sigma_rotation: float
    rule: str


def find(tx: Tx, object_id: int, digest: str) -> ChosenWidths | None:
    """What rows of this SHA-256 chose."""
    query = select(
        width_choices.c.sigma_position_m, width_choices.c.sigma_rotation, width_choices.c.rule
    ).where(width_choices.c.object_id == object_id, width_choices.c.digest == digest)
    return first_as(tx, query, ChosenWidths)


def add(tx: Tx, object_id: int, digest: str, found: ChosenWidths) -> None:
    """Keep a choice, unless it is kept or its object gone, and the newest of the object."""
    if tx.execute(select(objects.c.id).where(objects.c.id == object_id)).first() is None:
        return
    row = {"object_id": object_id, "digest": digest, **vars(found)}
    tx.execute(insert_or(tx, width_choices).values(row).on_conflict_do_nothing())
    of_object = width_choices.c.object_id == object_id
    newest = select(width_choices.c.number).where(of_object)
    last = newest.order_by(width_choices.c.number.desc()).offset(_MOST).limit(1).scalar_subquery()
    tx.execute(delete(width_choices).where(of_object, width_choices.c.number <= last))
