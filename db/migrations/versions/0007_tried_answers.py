"""the answer that a trial tried, and the pose that it achieved

Revision ID: 0007
Revises: 0006
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

ACHIEVED = tuple(f"achieved_{name}" for name in ("px", "py", "pz", "qx", "qy", "qz", "qw"))


def upgrade() -> None:
    # Added in place: a copy of every trial would take long, and no row needs a value.
    op.add_column("trials", sa.Column("answer_number", sa.BigInteger(), nullable=True))
    for name in ACHIEVED:
        op.add_column("trials", sa.Column(name, sa.Double(), nullable=True))
    op.create_index(
        "ix_trials_of_answers",
        "trials",
        ["object_id", "seq"],
        unique=False,
        sqlite_where=sa.text("answer_number IS NOT NULL"),
        postgresql_where=sa.text("answer_number IS NOT NULL"),
    )


def downgrade() -> None:
    op.drop_index("ix_trials_of_answers", table_name="trials")
    for name in ("answer_number", *ACHIEVED):
        op.execute(f"ALTER TABLE trials DROP COLUMN {name}")
