"""what estimators learned is kept, for all replicas

Revision ID: 0016
Revises: 0015
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None


def upgrade() -> None:
    big = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
    op.create_table(
        "learned_estimators",
        sa.Column("number", big, autoincrement=True, nullable=False),
        sa.Column("object_id", big, nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("epoch", sa.BigInteger(), nullable=False),
        sa.Column("attempts", sa.BigInteger(), nullable=False),
        sa.Column("content", sa.LargeBinary(), nullable=True),
        sa.ForeignKeyConstraint(
            ["object_id"],
            ["objects.id"],
            name=op.f("fk_learned_estimators_object_id_objects"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_learned_estimators")),
        sa.UniqueConstraint("object_id", "digest", name=op.f("uq_learned_estimators_object_id_digest")),
    )


def downgrade() -> None:
    op.drop_table("learned_estimators")
