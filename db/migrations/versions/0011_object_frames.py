"""objects have named frames

Revision ID: 0011
Revises: 0010
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("objects", sa.Column("frames", sa.JSON(), nullable=True))


def downgrade() -> None:
    op.execute("ALTER TABLE objects DROP COLUMN frames")
