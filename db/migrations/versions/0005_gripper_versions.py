"""versions of gripper profiles

Revision ID: 0005
Revises: 0004
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "gripper_versions",
        sa.Column(
            "id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), autoincrement=True, nullable=False
        ),
        sa.Column("gripper", sa.String(length=64), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("profile", sa.JSON(), nullable=False),
        sa.Column("changed", sa.JSON(), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["gripper"],
            ["grippers.id"],
            name=op.f("fk_gripper_versions_gripper_grippers"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_gripper_versions")),
        sa.UniqueConstraint("gripper", "version", name=op.f("uq_gripper_versions_gripper_version")),
        sqlite_autoincrement=True,
    )
    # What is stored is the first version, and what was tried and fitted was with that.
    op.execute(
        "INSERT INTO gripper_versions (gripper, version, profile, created_at)"
        " SELECT id, 1, profile, created_at FROM grippers"
    )
    # In place: on SQLite a copy of the table would take what refers to it along.
    op.execute("ALTER TABLE grippers DROP COLUMN profile")
    op.add_column("provenances", sa.Column("gripper_version", sa.Integer(), nullable=True))
    op.execute("UPDATE provenances SET gripper_version = 1 WHERE gripper IS NOT NULL")
    op.add_column("kernels", sa.Column("gripper_version", sa.Integer(), nullable=True))


def downgrade() -> None:
    op.execute("ALTER TABLE kernels DROP COLUMN gripper_version")
    op.execute("ALTER TABLE provenances DROP COLUMN gripper_version")
    op.add_column("grippers", sa.Column("profile", sa.JSON(), server_default="{}", nullable=False))
    op.execute(
        "UPDATE grippers SET profile = (SELECT v.profile FROM gripper_versions v"
        " WHERE v.gripper = grippers.id ORDER BY v.version DESC LIMIT 1)"
    )
    op.drop_table("gripper_versions")
