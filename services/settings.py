"""What the service may be told, each by an environment variable: SPLATPRESS_ and the field's name in capitals."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

from storage.place import is_remote

PREFIX = "SPLATPRESS_"
FROM_FILE = "_FILE"
LOOPBACK = ("127.0.0.1", "::1", "localhost")
DAY_S = 86_400


@dataclass(frozen=True)
class ServiceSettings:
    """All settings of the service; the environment has each as SPLATPRESS_ and its name."""

    data: Path = Path(
        "splatpress-data"
    )  # scans, uploads, work folders, results; shared by API, runner and workers; or s3://BUCKET/PREFIX
    state: Path = Path("splatpress-state")  # where data is a bucket: uploads and whatever else this machine keeps
    objects: str = ""  # the bucket's address, once `data` is this machine's folder beside it
    database: str = ""  # SQLAlchemy's URL; empty: SQLite in the data folder
    database_password: str = ""  # of a database whose URL has none; most often by SPLATPRESS_DATABASE_PASSWORD_FILE
    host: str = "127.0.0.1"
    port: int = 8000
    require_tokens: bool = False  # on loopback too, as behind a proxy; a request that came by one needs a token anyway
    scheduler: str = ""  # of Dask; empty: the runner starts workers of its own
    workers: int = 0  # that it starts; 0: one a core
    dashboard_url: str = ""  # where the API reaches Dask's pages, which it passes on; empty: where the runner says
    jobs_at_once: int = 2  # run side by side; the others wait in order
    max_upload_bytes: int = 50 << 30
    max_uploads_at_once: int = 20  # that are not whole yet, of one owner
    max_owner_bytes: int = 500 << 30  # of one owner's scans and open uploads
    max_multipart_bytes: int = 1 << 30
    max_unpacked_bytes: int = 200 << 30
    max_archive_files: int = 100_000
    max_archive_ratio: float = 100.0  # unpacked to packed; workspaces stay below 10, bombs start at 1000
    max_photo_pixels: int = 200_000_000
    max_jobs_in_flight: int = 500  # accepted or running, of one owner
    validation_s: float = 300.0  # a scan whose headers take longer is refused
    validation_memory_bytes: int = 8 << 30
    upload_expires_s: float = DAY_S  # after its last request
    headers_s: float = 20.0  # a connection whose request has no whole headers by then is closed
    body_idle_s: float = 60.0  # a request whose body stands still for so long is ended; what arrived of an upload stays
    retention_s: float = 30 * DAY_S  # after a job's end; pinned jobs stay
    audit_s: float = 365 * DAY_S  # how long it is kept who did what
    access_log: bool = False  # a line a request on the API's standard error
    reserve_bytes: int = 1 << 30  # no stage begins with less disk than this
    performance_from_s: float = (
        5.0  # shorter jobs get no page of Dask's: it takes the scheduler 0.8 s, all jobs waiting
    )
    webhook_private: bool = False  # whether webhooks may go to private addresses, and scans come from them
    fetch_from: str = ""  # s3://BUCKET/PREFIX,...: what scans may be fetched from with the service's own keys

    @property
    def place(self) -> Path:
        """Where scans, work folders and results lie: the data folder, or a bucket (storage/place)."""
        return Path(self.objects) if self.objects else self.data

    @property
    def database_url(self) -> str:
        if not self.database:
            return f"sqlite:///{self.data / 'splatpress.sqlite'}"
        if not self.database_password:
            return self.database
        from sqlalchemy import make_url

        return make_url(self.database).set(password=self.database_password).render_as_string(hide_password=False)

    @property
    def needs_tokens(self) -> bool:
        return self.require_tokens or self.host not in LOOPBACK

    def __post_init__(self) -> None:
        """The data folder becomes absolute here, once: children and workers run in folders of their own."""
        if is_remote(self.data):
            object.__setattr__(self, "objects", str(self.data))
            object.__setattr__(self, "data", self.state)
        if self.objects and len(Path(self.objects).parts) < 3:
            raise ValueError(f"{PREFIX}DATA is {self.objects!r}; allowed: a folder, or s3://BUCKET/PREFIX")
        object.__setattr__(self, "data", Path(os.path.abspath(self.data)))
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, (int, float)) and not isinstance(value, bool) and value < 0:
                raise ValueError(f"{PREFIX}{field.name.upper()} is {value}; allowed: 0 or more")


def settings_from(environment: Mapping[str, str] | None = None, **changes) -> ServiceSettings:
    """Settings from the environment, with changes; a change of None leaves what is there. A variable whose name goes on
    with _FILE names a file that holds the value.

    Raises: ValueError naming the variable and what it allows; OSError for a file that cannot be read.
    """
    environment = os.environ if environment is None else environment
    found = {}
    for field in fields(ServiceSettings):
        name = PREFIX + field.name.upper()
        text = environment.get(name)
        if not text and environment.get(name + FROM_FILE):
            text = Path(environment[name + FROM_FILE]).read_text().strip()
        if text:
            found[field.name] = _parsed(name, text, type(field.default))
    return ServiceSettings(**found | {name: value for name, value in changes.items() if value is not None})


def environment_of(settings: ServiceSettings) -> dict[str, str]:
    """The variables that `settings_from` turns into these settings again."""
    values = {field.name: getattr(settings, field.name) for field in fields(settings)}
    return {PREFIX + name.upper(): str(value) for name, value in values.items() if value != ""}


def _parsed(name: str, text: str, kind: type):
    if kind is bool:
        if text.lower() not in ("true", "false", "1", "0"):
            raise ValueError(f"{name} is {text!r}; allowed: true, false")
        return text.lower() in ("true", "1")
    try:
        return kind(text) if kind is not type(Path()) else Path(text)
    except ValueError:
        raise ValueError(f"{name} is {text!r}; allowed: {kind.__name__}") from None
