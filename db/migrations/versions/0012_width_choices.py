"""widths that were chosen are kept, for all replicas

Revision ID: 0012
Revises: 0011
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    big = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
    op.create_table(
        "width_choices",
        sa.Column("number", big, autoincrement=True, nullable=False),
        sa.Column("object_id", big, nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("sigma_position_m", sa.Double(), nullable=False),
        sa.Column("sigma_rotation", sa.Double(), nullable=False),
        sa.Column("rule", sa.String(length=32), nullable=False),
        sa.ForeignKeyConstraint(
            ["object_id"], ["objects.id"], name=op.f("fk_width_choices_object_id_objects"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_width_choices")),
        sa.UniqueConstraint("object_id", "digest", name=op.f("uq_width_choices_object_id_digest")),
    )


def downgrade() -> None:
    op.drop_table("width_choices")
