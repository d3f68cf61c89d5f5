"""Room for what is promised: an upload is only begun where all that is open would still fit beside it."""

from __future__ import annotations

import shutil
from pathlib import Path

from services.problems import RESOURCE
from services.settings import ServiceSettings
from services.store.rows import UploadRow
from services.store.store import Store
from services.uploads.tus import refusal


def upload_path(settings: ServiceSettings, upload: UploadRow) -> Path:
    """Where an upload arrives."""
    return settings.data / "uploads" / upload.id / upload.file


def received(settings: ServiceSettings, upload: UploadRow) -> int:
    """Bytes of it that are on disk."""
    path = upload_path(settings, upload)
    return path.stat().st_size if path.exists() else 0


def check_room(upload: UploadRow, settings: ServiceSettings, store: Store) -> None:
    """Raises Problem where the open uploads, this one among them, are more than its owner may have or the disk holds.

    The upload's row is there already, so that of two that come at once each sees the other.
    """
    opened = store.open_uploads()
    mine = [u for u in opened if u.owner == upload.owner]
    if len(mine) > settings.max_uploads_at_once:
        detail = f"{len(mine) - 1} uploads are open; allowed: {settings.max_uploads_at_once} of one owner"
        hint = "finish or delete one; GET /v1/uploads lists them"
        raise refusal(429, "too-many-uploads", detail, kind=RESOURCE, hint=hint, headers={"Retry-After": "60"})
    owned = store.bytes_of(upload.owner) + sum(max(0, u.length) for u in mine)
    if owned > settings.max_owner_bytes:
        detail = f"{owned:,} bytes of scans and uploads; allowed: {settings.max_owner_bytes:,} of one owner"
        raise refusal(413, "over-quota", detail, hint="delete scans that you need no longer")
    left = sum(max(0, u.length - received(settings, u)) for u in opened)
    free = shutil.disk_usage(settings.data).free - settings.reserve_bytes
    if left > free:
        detail = f"no room for {upload.length:,} bytes beside what other uploads were promised"
        raise refusal(507, "disk-full", detail, kind=RESOURCE, retryable=True)
