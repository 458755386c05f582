"""Identifiers from a path: what can't be one names nothing, and must not reach a database."""

from __future__ import annotations

import re
import uuid

_SLUG = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")

_VERSION = re.compile(r"[1-9][0-9]{0,8}")


def is_slug(name: str) -> bool:
    """Whether an object or a gripper could have this id."""
    return _SLUG.fullmatch(name) is not None


def is_gripper_name(name: str) -> bool:
    """Whether it could name a gripper or, as in ``panda@1``, a version of one."""
    gripper, at, version = name.partition("@")
    return is_slug(gripper) and (not at or _VERSION.fullmatch(version) is not None)


def is_uuid(name: str) -> bool:
    """Whether a batch, a sweep or a job could have this id."""
    try:
        return str(uuid.UUID(name)) == name
    except ValueError:
        return False
