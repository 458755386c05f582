"""a trial's named qualities; a batch's licence, citation and origin

Revision ID: 0010
Revises: 0009
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

OF_BATCHES: dict[str, sa.types.TypeEngine[object]] = {
    "licence": sa.String(100),
    "citation": sa.Text(),
    "origin": sa.JSON(),
    "quality_layout": sa.JSON(),
}


def upgrade() -> None:
    # Added in place: a copy of every trial would take long, and no row needs a value.
    op.add_column("objects", sa.Column("quality_names", sa.JSON(), nullable=True))
    for name, kind in OF_BATCHES.items():
        op.add_column("batches", sa.Column(name, kind, nullable=True))
    op.add_column("trials", sa.Column("qualities", sa.LargeBinary(), nullable=True))


def downgrade() -> None:
    op.execute("ALTER TABLE trials DROP COLUMN qualities")
    for name in OF_BATCHES:
        op.execute(f"ALTER TABLE batches DROP COLUMN {name}")
    op.execute("ALTER TABLE objects DROP COLUMN quality_names")
