"""objects that are copies

Revision ID: 0008
Revises: 0007
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("objects", sa.Column("copied_from", sa.JSON(), nullable=True))


def downgrade() -> None:
    op.execute("ALTER TABLE objects DROP COLUMN copied_from")
