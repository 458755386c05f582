"""Logs: one line an event, as text or JSON, with the request's id and key; nothing in it forges a line."""

from __future__ import annotations

import json
import logging
import re
import sys
import time
from typing import Any, Literal

from graspdb_service.telemetry import traces
from graspdb_service.telemetry.record import RECORD

LogFormat = Literal["text", "json"]

#: What would end a line, or move a terminal's cursor.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
#: Passwords in database URLs, and keys wherever they may have got into.
_SECRETS = (
    (re.compile(r"(://[^\s:/@]*:)[^\s@]+@"), r"\1***@"),
    (re.compile(r"(?i)(bearer\s+)\S+"), r"\1***"),
    (re.compile(r"\bgraspdb_([0-9A-Za-z]{4,16})_[A-Za-z0-9_\-]{20,}"), r"graspdb_\1_***"),
)
#: Libraries whose own debugging drowns ours.
_LOUD = ("numba", "matplotlib", "PIL", "asyncio", "httpcore", "urllib3", "opentelemetry")


def configure(format: LogFormat, level: str) -> None:
    """Write everything that is logged in this process, uvicorn's lines too, to standard error."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines() if format == "json" else TextLines())
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(level.upper())
    logging.captureWarnings(True)
    for name in ("uvicorn", "uvicorn.error", "uvicorn.access"):
        logger = logging.getLogger(name)
        logger.handlers = []
        logger.propagate = True
    for name in _LOUD:
        logging.getLogger(name).setLevel(max(logging.WARNING, root.level))


class _Lines(logging.Formatter):
    """The parts of a line: time, level, logger, message, the request's names, and what the event adds."""

    def parts(self, record: logging.LogRecord) -> dict[str, Any]:
        moment = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        request = RECORD.get()
        trace = traces.trace_id()
        return {
            "time": f"{moment}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": _clean(record.getMessage()),
            **({} if request is None else request.names()),
            **({} if trace is None else {"trace_id": trace}),
            **getattr(record, "fields", {}),
        }

    def traceback(self, record: logging.LogRecord) -> str:
        return _without_secrets(self.formatException(record.exc_info)) if record.exc_info else ""


class JsonLines(_Lines):
    """A JSON object a line."""

    def format(self, record: logging.LogRecord) -> str:
        parts = self.parts(record)
        if traceback := self.traceback(record):
            parts["exception"] = traceback
        return _without_secrets(json.dumps(parts, default=str))


class TextLines(_Lines):
    """``TIME LEVEL LOGGER MESSAGE name=value ...``; a traceback's lines are indented, whatever they say."""

    def format(self, record: logging.LogRecord) -> str:
        parts = self.parts(record)
        head = [parts.pop(name) for name in ("time", "level", "logger", "message")]
        head[1] = head[1].upper()
        more = [f"{name}={_value(value)}" for name, value in parts.items() if value is not None]
        line = _without_secrets(" ".join([*head, *more]))
        for under in self.traceback(record).splitlines():
            line += f"\n    {_clean(under)}"
        return line


def _value(value: Any) -> str:
    if isinstance(value, str) and not re.fullmatch(r"[\w./:{}@+\-]+", value, re.ASCII):
        return json.dumps(value)
    return str(value)


def _clean(text: str) -> str:
    return _CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def _without_secrets(text: str) -> str:
    for pattern, instead in _SECRETS:
        text = pattern.sub(instead, text)
    return text
