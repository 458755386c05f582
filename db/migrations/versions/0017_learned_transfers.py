"""what was learned of all objects that a gripper tried is kept, for all replicas

Revision ID: 0017
Revises: 0016
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None


def upgrade() -> None:
    big = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
    op.create_table(
        "learned_transfers",
        sa.Column("number", big, autoincrement=True, nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("objects", sa.JSON(), nullable=False),
        sa.Column("content", sa.LargeBinary(), nullable=True),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_learned_transfers")),
        sa.UniqueConstraint("digest", name=op.f("uq_learned_transfers_digest")),
        sqlite_autoincrement=True,
    )


def downgrade() -> None:
    op.drop_table("learned_transfers")
