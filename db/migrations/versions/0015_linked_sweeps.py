"""linked sweeps, and the engine in a trial's provenance

Revision ID: 0015
Revises: 0014
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None

_KIN = ("object_id", "gripper", "gripper_version", "source", "protocol")


def upgrade() -> None:
    # Added in place: null is what earlier versions knew.
    op.add_column("sweeps", sa.Column("linked", sa.String(36), nullable=True))
    op.add_column("packed_outcomes", sa.Column("measured", sa.LargeBinary(), nullable=True))
    op.add_column("provenances", sa.Column("engine", sa.String(64), nullable=True))
    _name_engines(op.get_bind())


def _name_engines(tx: sa.Connection) -> None:
    """Rows of sweeps all of whose chunks one engine simulated are of it from now on."""
    engines = (
        "SELECT s.id, s.object_id, s.provenance_id, b.id AS batch_id, b.first_seq, b.last_seq,"
        " min(o.engine) AS engine"
        " FROM sweeps s JOIN batches b ON b.sweep_id = s.id JOIN packed_outcomes o ON o.sweep_id = s.id"
        " WHERE s.purpose = 'collect' AND b.first_seq IS NOT NULL"
        # A sweep over the same grid that lost its batch may have left rows of another engine's.
        " AND NOT EXISTS (SELECT 1 FROM sweeps t LEFT JOIN batches c ON c.sweep_id = t.id"
        " WHERE t.provenance_id = s.provenance_id AND t.plan = 'grid' AND s.plan = 'grid'"
        " AND t.purpose = 'collect' AND c.id IS NULL)"
        " GROUP BY s.id, s.object_id, s.provenance_id, b.id, b.first_seq, b.last_seq"
        " HAVING count(*) = count(o.engine) AND min(o.engine) = max(o.engine)"
    )
    for sweep in tx.execute(sa.text(engines)).mappings().all():
        old, new = sweep["provenance_id"], _of_engine(tx, sweep["provenance_id"], sweep["engine"])
        rows = (
            "object_id = :object_id AND seq BETWEEN :first_seq AND :last_seq AND batch_id = :batch_id"
            " AND provenance_id = :old"
        )
        values = {**sweep, "old": old, "new": new}
        counted = f"SELECT outcome, count(*) FROM trials WHERE {rows} AND withdrawn IS NULL GROUP BY outcome"
        for outcome, count in tx.execute(sa.text(counted), values).all():
            _count(tx, old, outcome, -count)
            _count(tx, new, outcome, count)
        tx.execute(sa.text(f"UPDATE trials SET provenance_id = :new WHERE {rows}"), values)


def _of_engine(tx: sa.Connection, number: int, engine: str | None) -> int:
    """The provenance that is as this one but of an engine, made where there is none."""
    names = ", ".join(_KIN)
    own: dict[str, Any] = dict(
        tx.execute(sa.text(f"SELECT {names} FROM provenances WHERE id = :id"), {"id": number})
        .mappings()
        .one()
    )
    own["engine"] = engine
    same = " AND ".join(
        f"{name} IS NULL" if value is None else f"{name} = :{name}" for name, value in own.items()
    )
    found = tx.execute(sa.text(f"SELECT min(id) FROM provenances WHERE {same}"), own).scalar()
    if found is None:
        places = ", ".join(f":{name}" for name in own)
        tx.execute(sa.text(f"INSERT INTO provenances ({', '.join(own)}) VALUES ({places})"), own)
        found = tx.execute(sa.text(f"SELECT min(id) FROM provenances WHERE {same}"), own).scalar()
    return int(found or 0)


def _count(tx: sa.Connection, number: int, outcome: int, rows: int, packed: int = 0) -> None:
    place = {"number": number, "outcome": outcome, "rows": rows, "packed": packed}
    changed = tx.execute(
        sa.text(
            "UPDATE tallies SET row_count = row_count + :rows, packed_count = packed_count + :packed"
            " WHERE provenance_id = :number AND outcome = :outcome"
        ),
        place,
    )
    if changed.rowcount == 0:
        tx.execute(
            sa.text(
                "INSERT INTO tallies (provenance_id, outcome, row_count, packed_count)"
                " VALUES (:number, :outcome, :rows, :packed)"
            ),
            place,
        )


def downgrade() -> None:
    tx = op.get_bind()
    # Sweeps that compare are none that an earlier version knows.
    tx.execute(
        sa.text("DELETE FROM batches WHERE sweep_id IN (SELECT id FROM sweeps WHERE purpose = 'compare')")
    )
    compared = "(SELECT id FROM sweeps WHERE purpose = 'compare')"
    for table in ("packed_outcomes", "jobs"):
        tx.execute(sa.text(f"DELETE FROM {table} WHERE sweep_id IN {compared}"))
    tx.execute(sa.text("DELETE FROM sweeps WHERE purpose = 'compare'"))
    for number in tx.scalars(
        sa.text("SELECT id FROM provenances WHERE engine IS NOT NULL ORDER BY id")
    ).all():
        kin, values = _of_engine(tx, number, None), {"number": number}
        counted = "SELECT outcome, row_count, packed_count FROM tallies WHERE provenance_id = :number"
        for outcome, rows, packed in tx.execute(sa.text(counted), values).all():
            _count(tx, kin, outcome, rows, packed)
        values["kin"] = kin
        tx.execute(sa.text("DELETE FROM tallies WHERE provenance_id = :number"), values)
        for table in ("trials", "findings", "sweeps"):
            tx.execute(
                sa.text(f"UPDATE {table} SET provenance_id = :kin WHERE provenance_id = :number"), values
            )
        tx.execute(sa.text("DELETE FROM provenances WHERE id = :number"), values)
    for table, column in (("provenances", "engine"), ("packed_outcomes", "measured"), ("sweeps", "linked")):
        op.execute(f"ALTER TABLE {table} DROP COLUMN {column}")
