"""Robots' arms: which grasps they can take, and with which joints.

Arrays in, arrays out; no IO. What needs pinocchio and coal (the extra ``robot``) is in ``urdf``,
``collision`` and ``reaching``, which are imported where they are needed.
"""

from .arm import Arm, LinkSolid

__all__ = ["Arm", "LinkSolid"]
