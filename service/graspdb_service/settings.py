"""Settings from the environment (``GRASPDB_...``) or the command line."""

from __future__ import annotations

import ipaddress
import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from graspdb.wire.base import MAX_METADATA_LENGTH

DEFAULT_PORT = 8000


def is_loopback(host: str) -> bool:
    """Whether a host is this machine's own, which no other reaches."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _port(value: Any) -> Any:
    # A Kubernetes service or a docker link named graspdb sets GRASPDB_PORT=tcp://ADDRESS:PORT, not for us.
    return DEFAULT_PORT if isinstance(value, str) and "://" in value else value


def _listed(value: Any) -> Any:
    return [item.strip() for item in value.split(",") if item.strip()] if isinstance(value, str) else value


LogLevel = Literal["critical", "error", "warning", "info", "debug"]


def _in_small_letters(value: object) -> object:
    return value.lower() if isinstance(value, str) else value


class Settings(BaseSettings):
    """What a service process is told; every limit is answered by ``GET /info``."""

    model_config = SettingsConfigDict(env_prefix="GRASPDB_", extra="ignore", frozen=True)

    database_url: str = "sqlite:///graspdb.sqlite"
    """``sqlite:///relative.sqlite``, ``sqlite:////absolute.sqlite`` or ``postgresql://user@host/name``."""
    database_password_file: Path | None = None
    """A file with PostgreSQL's password, read for every new connection; a password in the URL comes first."""
    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65_535), BeforeValidator(_port)] = DEFAULT_PORT
    root_path: str = ""
    """Path under which a proxy serves this, such as ``/graspdb``."""
    auth: Literal["off", "keys"] | None = None
    """``keys`` serves who has one, ``off`` everybody; unset, ``off`` on loopback and ``keys`` elsewhere."""
    ssl_certfile: Path | None = None
    """A certificate and its chain, in PEM: the service speaks TLS with it."""
    ssl_keyfile: Path | None = None
    """The certificate's private key, where it is not in the same file."""
    allowed_hosts: Annotated[tuple[str, ...], NoDecode, BeforeValidator(_listed)] = ()
    """Hosts that are served without keys beside loopback, comma-separated; ``*`` is any."""

    threads: Annotated[int, Field(ge=1, le=256)] = max(1, os.cpu_count() or 1)
    """Threads of the compute pool; BLAS threads stay at 1."""

    max_requests_per_s: Annotated[float, Field(gt=0)] = 200.0
    """Requests a second of a key, where the key has no limit of its own; each process counts for itself."""
    max_request_burst: Annotated[int, Field(ge=1)] = 400
    """Requests that a key may make at once."""
    max_body_bytes: Annotated[int, Field(ge=1_000)] = 256 * 2**20
    """A body of trials, poses, obstacles or a mesh; any other has at most ``max_small_body_bytes``."""
    max_small_body_bytes: Annotated[int, Field(ge=1_000)] = 2**20
    max_bytes_in_flight: Annotated[int, Field(ge=1_000)] = 512 * 2**20
    """Bodies that the service holds at a time, all together; one client has at most half, or one body."""
    max_body_seconds: Annotated[float, Field(gt=0)] = 300.0
    """A body arrives within this, and after 10 s at ``min_body_bytes_per_second`` or faster."""
    min_body_bytes_per_second: Annotated[int, Field(ge=0)] = 16 * 2**10
    max_header_seconds: Annotated[float, Field(gt=0)] = 15.0
    """A request's head arrives within this, from its first byte or the connection's opening on."""
    max_idle_seconds: Annotated[int, Field(gt=0)] = 30
    """A connection is kept so long for another request."""
    max_reader_stall_seconds: Annotated[float, Field(gt=0)] = 30.0
    """Who takes an answer more slowly than ``min_body_bytes_per_second`` over this time is cut off."""
    max_connections: Annotated[int, Field(ge=10)] = 1_000
    """One more closes the one that has waited longest for a request; never more than open files allow."""
    max_json_values: Annotated[int, Field(ge=1_000)] = 50_000_000
    max_json_depth: Annotated[int, Field(ge=8, le=200)] = 32

    max_queries_at_once: Annotated[int, Field(ge=2)] = 24
    """Questions that are computed or wait for a processor; of one client three quarters, as of all below."""
    max_long_questions_at_once: Annotated[int, Field(ge=2)] = 8
    """Questions that go on after a quarter of a second's computing, the short ones apart; as many as
    ``max_queries_at_once`` wait for one of these places."""
    max_reports_at_once: Annotated[int, Field(ge=2)] = 10
    max_uploads_at_once: Annotated[int, Field(ge=2)] = 6
    max_meshes_at_once: Annotated[int, Field(ge=2)] = 4
    max_writes_at_once: Annotated[int, Field(ge=2)] = 10
    max_reads_at_once: Annotated[int, Field(ge=2)] = 24
    max_question_seconds: Annotated[float, Field(gt=0)] = 120.0
    """An answer to a question comes within this, or within its own ``timeout_s``."""
    max_waiting: Annotated[int, Field(ge=0)] = 100
    """Requests that wait for a place of a kind, clients in turn; the next is told 429."""
    max_waiting_seconds: Annotated[float, Field(gt=0)] = 20.0
    """How long a request waits for a place, or a body for room, before it is told 503."""
    max_mesh_bytes: Annotated[int, Field(ge=1_000)] = 64 * 2**20
    max_mesh_seconds: Annotated[float, Field(gt=0)] = 20.0
    max_mesh_memory_bytes: Annotated[int, Field(ge=2**28)] = 2 * 2**30
    max_batch_trials: Annotated[int, Field(ge=1)] = 1_000_000
    max_object_protocols: Annotated[int, Field(ge=1, le=10_000)] = 1_000
    max_object_provenances: Annotated[int, Field(ge=1, le=10_000)] = 5_000
    """Combinations of gripper, source, protocol and engine among an object's trials."""
    max_object_qualities: Annotated[int, Field(ge=0, le=10_000)] = 200
    """Names of qualities among an object's trials; those of a batch have at most 32."""
    max_metadata_bytes: Annotated[int, Field(ge=0, le=MAX_METADATA_LENGTH)] = MAX_METADATA_LENGTH
    """Of one trial, batch or object, as JSON."""
    max_query_poses: Annotated[int, Field(ge=1)] = 1_000_000
    max_samples: Annotated[int, Field(ge=1)] = 1_000_000
    max_sweep_poses: Annotated[int, Field(ge=1)] = 100_000_000
    max_density_cache_bytes: Annotated[int, Field(ge=2**20)] = 2**30
    learned_estimates: bool = True
    """Whether success probabilities are learned in the background from enough attempts; else the kernel
    estimate answers always."""
    max_answers: Annotated[int, Field(ge=1)] = 5_000
    """So many answers of each object and kind of question are kept, those given last, beside those that a
    name or a trial keeps; none is deleted within ten minutes."""

    max_database_connections: Annotated[int, Field(ge=4)] = 40
    """Connections of this process to its database; who finds none for 10 s is told 503."""
    max_statement_seconds: Annotated[float, Field(gt=0)] = 120.0
    """A statement, or a transaction that does nothing, ends on PostgreSQL after this."""
    min_free_disk_bytes: Annotated[int, Field(ge=0)] = 4 * 2**20
    """With less free under a SQLite database the service says that it is not ready."""
    probe_seconds: Annotated[float, Field(gt=0)] = 3.0
    """How often the service looks whether its database can be used."""

    log_format: Literal["text", "json"] = "text"
    log_level: Annotated[LogLevel, BeforeValidator(_in_small_letters)] = "info"

    keep_idempotency_days: Annotated[float, Field(gt=0)] = 30.0
    """So long a request that creates something may be sent again under its Idempotency-Key."""
    keep_audit_days: Annotated[float, Field(gt=0)] | None = None
    """Entries of the audit older than this are deleted; unset, none is."""
    keep_trials_days: Annotated[float, Field(gt=0)] | None = None
    """Whole batches older than this are deleted; unset, none is but by somebody's request."""
    keep_workers_days: Annotated[float, Field(gt=0)] = 90.0
    """Workers not seen for so long are listed no more."""
    upkeep_seconds: Annotated[float, Field(gt=0)] = 3_600.0
    """How often what is kept no longer is deleted."""

    lease_s: Annotated[float, Field(gt=0)] = 60.0
    """How long a worker keeps a job without renewing."""
    max_attempts: Annotated[int, Field(ge=1)] = 4
    """A job whose lease ran out this often is failed: it may be what kills the workers."""
    chunk_poses: Annotated[int, Field(ge=1)] = 20_000
    report_wait_s: Annotated[float, Field(ge=0, le=60)] = 10.0
    """How long a request waits for a report before it is told where the report will be."""
    retry_after_s: Annotated[float, Field(gt=0)] = 2.0
    """How long an idle worker is told to wait before it asks for jobs again."""

    @property
    def uses_keys(self) -> bool:
        """Whether callers need keys."""
        return self.auth == "keys" or (self.auth is None and not is_loopback(self.host))
