"""trials withdrawn and corrected, with their history

Revision ID: 0004
Revises: 0003
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    # Added in place: a copy of every trial would take long, and no row needs a value.
    op.add_column("trials", sa.Column("withdrawn", sa.Boolean(), nullable=True))
    op.create_table(
        "trial_changes",
        sa.Column("object_id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("seq", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("revision", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("before", sa.JSON(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("changed_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["object_id"], ["objects.id"], name=op.f("fk_trial_changes_object_id_objects"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("object_id", "seq", "revision", name=op.f("pk_trial_changes")),
    )


def downgrade() -> None:
    op.drop_table("trial_changes")
    with op.batch_alter_table("trials", schema=None) as batch_op:
        batch_op.drop_column("withdrawn")
