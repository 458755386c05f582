"""how often a pose was tried and how often it succeeded, of trials and of sweeps' packed outcomes

Revision ID: 0014
Revises: 0013
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

SEVERAL = sa.text("attempts IS NOT NULL")


def upgrade() -> None:
    # Added in place: null is one attempt, as earlier versions knew no others.
    for name in ("attempts", "successes"):
        op.add_column("trials", sa.Column(name, sa.Integer(), nullable=True))
    op.add_column("packed_outcomes", sa.Column("successes", sa.LargeBinary(), nullable=True))
    op.create_index(
        "ix_trials_of_several",
        "trials",
        ["object_id", "seq"],
        sqlite_where=SEVERAL,
        postgresql_where=SEVERAL,
    )


def downgrade() -> None:
    op.drop_index("ix_trials_of_several", table_name="trials")
    op.execute("ALTER TABLE packed_outcomes DROP COLUMN successes")
    for name in ("attempts", "successes"):
        op.execute(f"ALTER TABLE trials DROP COLUMN {name}")
