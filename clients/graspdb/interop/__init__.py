"""The field's files: grasps in the formats of other projects, read as trials of an object.

``read("mug.h5", gripper=db.grippers.get("panda"))`` gives poses of the tool in the object's frame, outcomes,
qualities, and a report of what was recognised, assumed, mapped and dropped.
"""

from __future__ import annotations

from graspdb.interop.formats.known import FORMATS as FORMATS
from graspdb.interop.grasps import FileGrasps as FileGrasps
from graspdb.interop.grasps import Report as Report
from graspdb.interop.reading import ReadOptions as ReadOptions
from graspdb.interop.reading import read as read
from graspdb.interop.writing import WRITTEN as WRITTEN
from graspdb.interop.writing import write as write
