"""which physics engine a job asks for, and which simulated a chunk

Revision ID: 0013
Revises: 0012
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    # Added in place: null is what earlier versions knew.
    op.add_column("jobs", sa.Column("engine", sa.String(16), nullable=True))
    op.add_column("packed_outcomes", sa.Column("engine", sa.String(64), nullable=True))


def downgrade() -> None:
    for table in ("jobs", "packed_outcomes"):
        op.execute(f"ALTER TABLE {table} DROP COLUMN engine")
