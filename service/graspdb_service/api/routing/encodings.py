"""Bodies that come compressed: decoded as they arrive, so that every limit counts what they hold."""

from __future__ import annotations

import asyncio
import zlib
from collections.abc import AsyncGenerator

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_CODINGS = ("gzip", "x-gzip", "deflate")
_END: Message = {"type": "http.request", "body": b"", "more_body": False}
#: Bytes that are decoded at a time: other requests have their turn between two of these.
_PIECE = 2**20
#: Streams in one body, one after the other as gzip allows: even an empty one takes time.
_MOST_STREAMS = 10_000


class Decoding:
    """Hands on the bytes that a body with ``Content-Encoding: gzip`` or ``deflate`` stands for.

    Raised as the body is read: 415 for another coding, 400 where it is not what it says, 413 where it takes
    more than ``max_body_bytes``, as it came or decoded.
    """

    def __init__(self, app: ASGIApp, max_body_bytes: int) -> None:
        self.app = app
        self.max_body_bytes = max_body_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        coding = Headers(scope=scope).get("content-encoding", "") if scope["type"] == "http" else ""
        coding = coding.strip().lower()
        if coding in ("", "identity"):
            await self.app(scope, receive, send)
            return
        told = (b"content-encoding", b"content-length", b"transfer-encoding")
        headers = [(name, value) for name, value in scope["headers"] if name not in told]
        # How long it will be is not known any more.
        inner = {**scope, "headers": [*headers, (b"transfer-encoding", b"chunked")]}
        messages = _decoded(receive, coding, self.max_body_bytes)

        async def decoded() -> Message:
            async for message in messages:
                return message
            return await receive()

        try:
            await self.app(inner, decoded, send)
        finally:
            await messages.aclose()
            if "route" in inner:
                scope["route"] = inner["route"]


async def _decoded(receive: Receive, coding: str, most: int) -> AsyncGenerator[Message, None]:
    """What ``receive`` brings of a body, decoded, a piece a message."""
    if coding not in _CODINGS:
        raise HTTPException(
            415,
            f"Content-Encoding {coding[:40]} is not understood: send gzip, deflate, or the body as it is",
            headers={"Accept-Encoding": "gzip, deflate"},
        )
    stream = None
    came = size = streams = 0
    more = True
    while more:
        message = await receive()
        if message["type"] != "http.request":
            yield message
            return
        more, body = message.get("more_body", False), message.get("body", b"")
        came += len(body)
        full = False
        while body or full:
            if stream is None or stream.eof:
                streams += 1
                if streams > (1 if coding == "deflate" else _MOST_STREAMS):
                    raise _wrong(coding, "too much follows its end")
                stream = zlib.decompressobj(_window_bits(coding, body[0]))
            try:
                piece = stream.decompress(body, _PIECE)
            except zlib.error as error:
                raise _wrong(coding, str(error)) from None
            body = stream.unused_data if stream.eof else stream.unconsumed_tail
            # A full piece may leave something to say without more to read.
            full = len(piece) == _PIECE and not stream.eof
            size += len(piece)
            if max(came, size) > most:
                raise HTTPException(413, f"The decoded body is over the limit of {most:,} bytes (see /info)")
            if piece:
                yield {"type": "http.request", "body": piece, "more_body": True}
                await asyncio.sleep(0)
    if stream is not None and not stream.eof:
        raise _wrong(coding, "it ends too early")
    yield _END


def _window_bits(coding: str, first: int) -> int:
    """How zlib is told what to read; ``deflate`` is often sent without the header that belongs to it."""
    if coding != "deflate":
        return 16 + zlib.MAX_WBITS
    return zlib.MAX_WBITS if first & 0x8F == 0x08 else -zlib.MAX_WBITS


def _wrong(coding: str, why: str) -> HTTPException:
    return HTTPException(400, f"The body is not {coding}, as Content-Encoding says: {why}")
