"""What a body is and what an answer is to be: media types, Content-Type and Accept."""

from __future__ import annotations

from fastapi import Request

from graspdb_service.problems import ProblemError

JSON = "application/json"
NDJSON = "application/x-ndjson"
ARROW = "application/vnd.apache.arrow.stream"
GLB = "model/gltf-binary"
PNG, SVG = "image/png", "image/svg+xml"

BINARY = {"type": "string", "format": "binary"}
"""The schema of a binary body."""


def media_type(request: Request) -> str:
    """The body's media type without parameters, lower case; empty where none is given."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


def unsupported(title: str, media: str | None = None) -> ProblemError:
    """415: the body is of a media type that this route does not take."""
    detail = None if media is None else f"Content-Type was {media or 'missing'}"
    return ProblemError(415, "unsupported-media-type", title, detail=detail)


def one_of(request: Request, *kinds: str) -> str:
    """The body's media type, which must be one of these, else 415."""
    media = media_type(request)
    if media not in kinds:
        raise unsupported(f"Send {' or '.join(kinds)} and say which by Content-Type", media)
    return media


def require_json(request: Request) -> None:
    """Refuse (415) a body that says it is something else than JSON."""
    media = media_type(request)
    if media and not media.endswith("json"):
        raise unsupported("Send JSON, with Content-Type: application/json")


def accepted(request: Request, *kinds: str) -> str:
    """The media type preferred: by weight, then as named and not by ``*``, then as listed; else 406."""
    ranks: dict[str, tuple[float, int, int]] = {}
    for place, item in enumerate((request.headers.get("accept") or "*/*").split(",")):
        media, *parameters = (part.strip().lower() for part in item.split(";"))
        weight = _weight(parameters)
        for order, kind in enumerate(kinds):
            family = kind.partition("/")[0] + "/*"
            named = (kind, family, "*/*", "").index(media) if media in (kind, family, "*/*", "") else None
            # The more specific of two that match says the weight (RFC 9110, 12.5.1).
            if named is not None and (kind not in ranks or -named > ranks[kind][1]):
                ranks[kind] = (weight, -named, -place if named == 0 else -order)
    best = max(kinds, key=lambda kind: ranks.get(kind, (0.0, 0, 0)))
    if ranks.get(best, (0.0,))[0] <= 0.0:
        raise ProblemError(
            406,
            "not-acceptable",
            f"This comes as {', '.join(kinds[:-1])} or {kinds[-1]}: say which by Accept",
        )
    return best


def _weight(parameters: list[str]) -> float:
    for item in parameters:
        name, _, value = item.partition("=")
        if name.strip() == "q":
            try:
                return float(value)
            except ValueError:
                return 0.0
    return 1.0
