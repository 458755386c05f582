"""answers as they were given, and their names

Revision ID: 0006
Revises: 0005
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    big = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
    op.create_table(
        "answers",
        sa.Column("number", big, autoincrement=True, nullable=False),
        sa.Column("id", sa.String(length=20), nullable=False),
        sa.Column("object_id", big, nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("revision", sa.BigInteger(), nullable=False),
        sa.Column("gripper", sa.String(length=80), nullable=True),
        sa.Column("protocol", sa.String(length=64), nullable=True),
        sa.Column("source", sa.String(length=16), nullable=True),
        sa.Column("version", sa.String(length=40), nullable=False),
        sa.Column("question", sa.LargeBinary(), nullable=False),
        sa.Column("result", sa.LargeBinary(), nullable=False),
        sa.Column("trial_count", sa.BigInteger(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("asked_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["object_id"], ["objects.id"], name=op.f("fk_answers_object_id_objects"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("number", name=op.f("pk_answers")),
        sa.UniqueConstraint("id", name=op.f("uq_answers_id")),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_answers_recent", "answers", ["object_id", "kind", "asked_at"], unique=False)
    op.create_table(
        "answer_names",
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("answer_number", big, nullable=False),
        sa.ForeignKeyConstraint(
            ["answer_number"],
            ["answers.number"],
            name=op.f("fk_answer_names_answer_number_answers"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_answer_names")),
    )
    op.create_index(op.f("ix_answer_names_answer_number"), "answer_names", ["answer_number"], unique=False)


def downgrade() -> None:
    op.drop_table("answer_names")
    op.drop_table("answers")
