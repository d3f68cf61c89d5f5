"""Webhooks signed by Standard Webhooks, to public addresses alone.

The name is resolved once, every address it has must be public, and the connection goes to that very address, so that a
second answer of the name server leads nowhere. Redirects are not followed.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import secrets
from base64 import b64encode
from collections.abc import Callable
from datetime import UTC, datetime

import httpx
from sqlalchemy.exc import IntegrityError
from standardwebhooks import Webhook

from services.addresses import RefusedAddress, check_url, public_address
from services.settings import ServiceSettings
from services.store.rows import JobRow
from services.store.store import Store
from storage import place

BACKOFF_S = (5, 30, 120, 600, 3600, 6 * 3600)  # after each failed try; then it is given up
TIMEOUT_S = 10.0
AT_ONCE, AT_ONCE_OF_ONE_OWNER = 20, 4


def owner_secret(settings: ServiceSettings, owner: str) -> str:
    """The secret that an owner's webhooks are signed with; every owner has another."""
    key = place.made_once(settings.place / "webhook-key", lambda: secrets.token_bytes(32))
    return "whsec_" + b64encode(hmac.digest(key, owner.encode(), hashlib.sha256)).decode()


def deliver_due(
    settings: ServiceSettings, store: Store, describe: Callable[[JobRow], dict], timeout_s: float = TIMEOUT_S
) -> None:
    """Try each due webhook once, side by side; `describe(job)` is its payload's data.

    Guarantees: each try ends within `timeout_s`, whatever its host does; no entry hinders another's; one that meets an
    error of ours is given up, so that it is not met again for ever. Raises: only for a database that is away.
    """
    due = store.due_webhooks(AT_ONCE, AT_ONCE_OF_ONE_OWNER)

    async def try_all() -> list[BaseException | None]:
        return await asyncio.gather(
            *(_deliver(job, settings, describe, timeout_s) for job in due), return_exceptions=True
        )

    for job, error in zip(due, asyncio.run(try_all()), strict=True):
        next_due, level, message = _outcome(error, job.webhook_tries)
        try:
            store.note_webhook(job.id, job.attempt, next_due)
            store.log(job.id, level, message)
        except IntegrityError:  # the job was deleted meanwhile
            pass


def _outcome(error: BaseException | None, tries: int) -> tuple[float | None, str, str]:
    """When it is due again, and what the job's log says at which level."""
    if error is None:
        return None, "info", "webhook delivered"
    if isinstance(error, RefusedAddress):
        return None, "warning", f"webhook refused: {error}"
    if not isinstance(error, (httpx.HTTPError, TimeoutError)):
        return None, "error", f"webhook given up ({type(error).__name__}: {error})"
    again = tries < len(BACKOFF_S)
    when = f"again in {BACKOFF_S[tries]} s" if again else "given up"
    next_due = datetime.now().timestamp() + BACKOFF_S[tries] if again else None
    return next_due, "warning", f"webhook failed ({type(error).__name__}: {error}), {when}"


async def _deliver(
    job: JobRow, settings: ServiceSettings, describe: Callable[[JobRow], dict], timeout_s: float
) -> None:
    url = check_url(job.webhook, settings.webhook_private)
    host, port = url.raw_host.decode("ascii"), url.port or (443 if url.scheme == "https" else 80)
    now = datetime.now(UTC)
    body = json.dumps({"type": f"job.{job.status}", "timestamp": now.isoformat(), "data": describe(job)})
    id = f"msg_{job.id}_{job.attempt}_{job.status}"
    signature = Webhook(owner_secret(settings, job.owner)).sign(id, now, body)
    headers = {
        "host": url.netloc.decode(),
        "content-type": "application/json",
        "webhook-id": id,
        "webhook-timestamp": str(int(now.timestamp())),
        "webhook-signature": signature,
    }
    async with asyncio.timeout(timeout_s):
        address = await asyncio.to_thread(public_address, host, port, settings.webhook_private)
        async with (
            httpx.AsyncClient(timeout=timeout_s, follow_redirects=False, trust_env=False) as client,
            client.stream(
                "POST", url.copy_with(host=address), content=body, headers=headers, extensions={"sni_hostname": host}
            ) as response,
        ):  # its body is not read
            if not response.is_success:
                raise httpx.HTTPStatusError(
                    f"answered {response.status_code}", request=response.request, response=response
                )
