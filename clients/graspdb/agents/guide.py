"""What agents may read beside the answers: the guide, and pictures."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graspdb import wire
from graspdb.errors import GraspDBError, NotFound
from graspdb.figures.frames.gripper import draw_gripper
from graspdb.resources.pages import segment
from graspdb.transport import Transport

if TYPE_CHECKING:
    from mcp.server.mcpserver import MCPServer

_PNG = "image/png"


_GUIDE = (
    "frames", "densities", "scores", "objects", "grippers", "trials", "import", "best-grasp", "next-trials",
    "reports", "kernels", "sweeps", "viewer", "agents", "errors", "deploying", "compose", "operations",
)  # fmt: skip
_BESIDE = ("http", "glossary")
PAGES = _GUIDE + _BESIDE
"""What a user of the service reads: the pages that come with the package."""


def pages() -> Mapping[str, Path]:
    """The guide's pages by name: inside an installed wheel, or in the checkout's ``docs``."""
    package = Path(__file__).resolve().parents[1]
    installed, docs = package / "guide", package.parents[1] / "docs"
    guide, beside = (installed, installed) if installed.is_dir() else (docs / "guide", docs)
    if not guide.is_dir():
        raise FileNotFoundError("the guide is missing from this installation of graspdb")
    return {name: (guide if name in _GUIDE else beside) / f"{name}.md" for name in PAGES}


def add_resources(server: MCPServer[Any], transport: Transport) -> None:
    """The guide's pages, and the figures of reports and grippers, which are drawn when they are read."""

    @server.resource("graspdb://guide", mime_type="text/markdown", description="The pages of the guide.")
    def contents() -> str:
        return "\n".join(f"- graspdb://guide/{name}: {_title(page)}" for name, page in pages().items())

    @server.resource("graspdb://guide/{page}", mime_type="text/markdown", description="A page of the guide.")
    @_refusals
    def page(page: str) -> str:
        found = pages().get(page)
        if found is None:
            raise NotFound(f"the guide has no page {page!r}; it has {', '.join(pages())}")
        return found.read_text(encoding="utf-8")

    @server.resource(
        "graspdb://objects/{object}/reports/{report}.png",
        mime_type=_PNG,
        description="The figure of a report, one of those that tool `report` knows.",
    )
    @_refusals
    def figure(object: str, report: str) -> bytes:
        path = f"/objects/{segment(object)}/reports/{segment(report)}"
        answer = transport.request("GET", path, headers={"Accept": _PNG})
        if answer.status_code == 202:
            raise GraspDBError(f"the {report} report is being computed: ask again in a while")
        return answer.content

    @server.resource(
        "graspdb://grippers/{gripper}.png",
        mime_type=_PNG,
        description="A gripper from two sides with its named frames, to scale.",
    )
    @_refusals
    def gripper_frames(gripper: str) -> bytes:
        info = transport.model(wire.GripperInfo, "GET", f"/grippers/{segment(gripper)}")
        target = io.BytesIO()
        draw_gripper(info.id, info.profile).savefig(target, format="png", dpi=120)
        return target.getvalue()


def _title(page: Path) -> str:
    return page.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ")


def _refusals(read: Callable[..., Any]) -> Callable[..., Any]:
    """Refusals as resources tell them, in the service's words."""
    from mcp.server.mcpserver.exceptions import ResourceError, ResourceNotFoundError

    @functools.wraps(read)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return read(*args, **kwargs)
        except NotFound as error:
            raise ResourceNotFoundError(str(error)) from error
        except (GraspDBError, ImportError, OSError, ValueError) as error:
            raise ResourceError(str(error)) from error

    return call
