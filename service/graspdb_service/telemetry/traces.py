"""OpenTelemetry traces, where the extra ``otel`` is there and OTEL_* variables ask for them; else nothing."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

log = logging.getLogger("graspdb")

#: The tracer and what reads a caller's trace from headers, once started.
_started: tuple[Any, Any] | None = None


def wanted() -> bool:
    """Whether the environment names where traces go."""
    if os.environ.get("OTEL_SDK_DISABLED", "").lower() == "true":
        return False
    exporter = os.environ.get("OTEL_TRACES_EXPORTER", "").lower()
    if exporter:
        return exporter != "none"
    return any(
        os.environ.get(name) for name in ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
    )


def start() -> None:
    """Send spans to where OTEL_* say; a warning where the extra is missing."""
    global _started
    if not wanted():
        return
    try:
        _started = _tracer(), _propagator()
    except ModuleNotFoundError as error:
        log.warning("OTEL_* ask for traces, which need %s: pip install 'graspdb[otel]'", error.name)


def _tracer() -> Any:
    from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
    from opentelemetry.sdk.resources import SERVICE_NAME, Resource
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import BatchSpanProcessor, ConsoleSpanExporter

    console = os.environ.get("OTEL_TRACES_EXPORTER", "").lower() == "console"
    # What OTEL_RESOURCE_ATTRIBUTES, OTEL_TRACES_SAMPLER and OTEL_BSP_* say is read by the SDK itself; it
    # sends what is left when the process ends.
    named = os.environ.get("OTEL_SERVICE_NAME", "graspdb")
    provider = TracerProvider(resource=Resource.create({SERVICE_NAME: named}))
    provider.add_span_processor(BatchSpanProcessor(ConsoleSpanExporter() if console else OTLPSpanExporter()))
    return provider.get_tracer("graspdb")


def _propagator() -> Any:
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    return TraceContextTextMapPropagator()


def span(name: str) -> AbstractContextManager[Any]:
    """A span below the current one; nothing where traces are off."""
    return nullcontext() if _started is None else _started[0].start_as_current_span(name)


def request_span(headers: Iterable[tuple[bytes, bytes]]) -> AbstractContextManager[Any]:
    """The span of a request, below its caller's where the headers name one; its value is None when off."""
    if _started is None:
        return nullcontext()
    from opentelemetry.trace import SpanKind

    tracer, propagator = _started
    carrier = {
        name.decode("latin-1"): value.decode("latin-1")
        for name, value in headers
        if name in (b"traceparent", b"tracestate")
    }
    parent = propagator.extract(carrier)
    return tracer.start_as_current_span("request", context=parent, kind=SpanKind.SERVER)  # type: ignore[no-any-return]


def trace_id() -> str | None:
    """The current trace's id, for the log."""
    if _started is None:
        return None
    from opentelemetry.trace import get_current_span

    context = get_current_span().get_span_context()
    return f"{context.trace_id:032x}" if context.is_valid else None
