"""Webhooks signed by Standard Webhooks, to public addresses alone.

The name is resolved once, every address it has must be public, and the connection goes to that very address, so that a
second answer of the name server leads nowhere. Redirects are not followed.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import json
import os
import secrets
import socket
from base64 import b64encode
from datetime import datetime, timezone
from urllib.parse import urlsplit

import httpx
from standardwebhooks import Webhook

from services.settings import ServiceSettings
from services.store import Store

BACKOFF_S = (5, 30, 120, 600, 3600, 6 * 3600)  # after each failed try; then it is given up
TIMEOUT_S = 10.0


class RefusedAddress(Exception):
    """A webhook that leads into a private network, or whose name leads nowhere."""


def owner_secret(settings: ServiceSettings, owner: str) -> str:
    """The secret that an owner's webhooks are signed with; every owner has another."""
    path = settings.data / "webhook-key"
    if not path.is_file():
        partial = path.with_name(f"webhook-key.{secrets.token_hex(4)}.partial")
        with open(os.open(partial, os.O_WRONLY | os.O_CREAT, 0o600), "wb") as stream:
            stream.write(secrets.token_bytes(32))
        try:
            os.link(partial, path)  # unlike a rename this never replaces another's
        except FileExistsError:
            pass
        partial.unlink()
    return "whsec_" + b64encode(hmac.digest(path.read_bytes(), owner.encode(), hashlib.sha256)).decode()


def check_url(url: str, allow_private: bool) -> None:
    """What can be said without asking a name server. Raises RefusedAddress."""
    parts = urlsplit(url)
    try:
        port_is_number = parts.port is None or parts.port > 0
    except ValueError:
        port_is_number = False
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.username or not port_is_number:
        raise RefusedAddress("a webhook is an http or https URL with a host and without a password")
    if allow_private:
        return
    try:
        address = ipaddress.ip_address(parts.hostname)
    except ValueError:
        if parts.hostname.rstrip(".").rpartition(".")[2].lower() in ("localhost", "local", "internal", parts.hostname.lower()):
            raise RefusedAddress(f"{parts.hostname} names a private host") from None
        return
    _refuse_private(address)


def _refuse_private(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> None:
    address = getattr(address, "ipv4_mapped", None) or address
    if not address.is_global or address.is_multicast:
        raise RefusedAddress(f"{address} is a private address")


def _public_address(host: str, port: int, allow_private: bool) -> str:
    try:
        found = [info[4][0] for info in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)]
    except OSError as error:
        raise RefusedAddress(f"{host} has no address ({error})") from error
    for address in found if not allow_private else ():
        _refuse_private(ipaddress.ip_address(address.partition("%")[0]))
    return found[0]


def deliver_due(settings: ServiceSettings, store: Store, describe) -> None:
    """Try each due webhook once; `describe(job)` is its payload's data."""
    for job in store.due_webhooks(20):
        try:
            _deliver(job, settings, describe(job))
            next_due = None
            store.log(job["id"], "info", "webhook delivered")
        except RefusedAddress as error:
            next_due = None
            store.log(job["id"], "warning", f"webhook refused: {error}")
        except httpx.HTTPError as error:
            tries = job["webhook_tries"]
            next_due = datetime.now().timestamp() + BACKOFF_S[tries] if tries < len(BACKOFF_S) else None
            when = f"again in {BACKOFF_S[tries]} s" if next_due else "given up"
            store.log(job["id"], "warning", f"webhook failed ({type(error).__name__}: {error}), {when}")
        store.note_webhook(job["id"], job["attempt"], next_due)


def _deliver(job: dict, settings: ServiceSettings, data: dict) -> None:
    check_url(job["webhook"], settings.webhook_private)
    url = httpx.URL(job["webhook"])
    port = url.port or (443 if url.scheme == "https" else 80)
    address = _public_address(url.host, port, settings.webhook_private)
    now = datetime.now(timezone.utc)
    body = json.dumps({"type": f"job.{job['status']}", "timestamp": now.isoformat(), "data": data})
    id = f"msg_{job['id']}_{job['attempt']}_{job['status']}"
    signature = Webhook(owner_secret(settings, job["owner"])).sign(id, now, body)
    with httpx.Client(timeout=TIMEOUT_S, follow_redirects=False, trust_env=False) as client:
        response = client.post(
            url.copy_with(host=address), content=body, extensions={"sni_hostname": url.host},
            headers={"host": url.netloc.decode(), "content-type": "application/json", "webhook-id": id,
                     "webhook-timestamp": str(int(now.timestamp())), "webhook-signature": signature},
        )
    if not response.is_success:
        raise httpx.HTTPStatusError(f"answered {response.status_code}", request=response.request, response=response)
