"""What the store keeps and tells, as types: a row of each table, and what a new one is made of.

Times are seconds since 1970. `header`, `settings`, `knobs`, `live`, `problem` and `data` are JSON as the API shows them
(`services.jobs.documents`); what they hold is published there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

ACCEPTED, RUNNING, SUCCESSFUL, FAILED, DISMISSED = STATES = ("accepted", "running", "successful", "failed", "dismissed")
LIVE = (ACCEPTED, RUNNING)
LEVELS = ("debug", "info", "warning", "error")

Json = dict[str, Any]


@dataclass(frozen=True)
class ScanRow:
    """A scan as one owner knows it: `file` is the owner's name for it, `path_name` its name on disk."""

    id: str  # SHA-256 of its bytes
    file: str
    path_name: str
    bytes: int
    header: Json
    created: float


@dataclass(frozen=True)
class NewJob:
    """What a job is asked for with; `knobs` and `budget_s` are those of a trade-off."""

    owner: str
    scan: str
    name: str
    settings: Json
    process: str
    knobs: Json | None = None
    budget_s: float | None = None
    webhook: str | None = None
    request_key: str | None = None  # the Idempotency-Key, and a hash of the request that it came with
    request_hash: str | None = None


@dataclass(frozen=True)
class JobRow:
    """A job. `attempt` counts from 1; `progress` is in percent; `live` is splats a second, seconds left, current
    PSNR."""

    id: str
    owner: str
    scan: str
    name: str
    settings: Json
    process: str
    knobs: Json | None
    budget_s: float | None
    webhook: str | None
    webhook_due: float | None
    webhook_tries: int
    status: str
    attempt: int
    progress: int
    stage: str | None
    message: str | None
    problem: Json | None
    live: Json | None
    created: float
    started: float | None
    finished: float | None
    updated: float
    pinned: bool
    request_key: str | None
    request_hash: str | None


@dataclass(frozen=True)
class EventRow:
    """What happened to a job: `kind` is status, progress, learning or log; `level` of a log line alone."""

    id: int
    job: str
    time: float
    kind: str
    level: str | None
    data: Json


@dataclass(frozen=True)
class ArtifactRow:
    """A file that a job made, under its `name`; `path` is below the job's folder."""

    name: str
    path: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class ExportRow:
    """An export that was asked for; `problem` says why it could not be made, None while it is wanted."""

    job: str
    format: str
    requested: float
    problem: Json | None


@dataclass(frozen=True)
class UploadRow:
    """Bytes that arrive. `length` is -1 until it is said; `scan` what the whole became; `concat` as tus has it."""

    id: str
    owner: str
    file: str
    length: int
    metadata: str
    expires: float
    scan: str | None = None
    problem: Json | None = None
    concat: str = ""


@dataclass(frozen=True)
class TokenRow:
    """A token, by its hash; the token itself is kept nowhere. `expires` None: never; `used` to the minute."""

    hash: str
    owner: str
    created: float
    label: str
    expires: float | None
    used: float | None


@dataclass(frozen=True)
class ActionRow:
    """Who did what, and from which address."""

    id: int
    time: float
    owner: str
    action: str
    target: str
    client: str


@dataclass(frozen=True)
class StageTotals:
    """All runs of a stage, summed."""

    stage: str
    seconds: float
    runs: int
    splats: int


@dataclass(frozen=True)
class Figures:
    """What /metrics tells: jobs by state, stages, and bytes of scans and of artifacts."""

    jobs: dict[str, int]
    stages: list[StageTotals]
    scan_bytes: int
    artifact_bytes: int
