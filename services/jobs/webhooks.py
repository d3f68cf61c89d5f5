"""Webhooks signed by Standard Webhooks, to public addresses alone.

The name is resolved once, every address it has must be public, and the connection goes to that very address, so that a
second answer of the name server leads nowhere. Redirects are not followed.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import json
import re
import secrets
import socket
from base64 import b64encode
from collections.abc import Callable
from datetime import UTC, datetime

import httpx
from sqlalchemy.exc import IntegrityError
from standardwebhooks import Webhook

from services.settings import ServiceSettings
from services.store.store import Store
from storage import place

BACKOFF_S = (5, 30, 120, 600, 3600, 6 * 3600)  # after each failed try; then it is given up
TIMEOUT_S = 10.0
AT_ONCE, AT_ONCE_OF_ONE_OWNER = 20, 4
MAX_NAME = 253
_LABEL = re.compile(r"[a-z0-9_]([a-z0-9_-]{0,61}[a-z0-9_])?")
_NUMBER = re.compile(r"[0-9]+|0x[0-9a-f]*")  # a host that ends in one is an IPv4 address (WHATWG URL, 3.5)
_UNICAST = ipaddress.ip_network("2000::/3")  # all global IPv6 addresses are from here, but for those of NAT64
_NAT64 = ipaddress.ip_network("64:ff9b::/96")


class RefusedAddress(Exception):
    """A webhook that leads into a private network, or whose name leads nowhere."""


def owner_secret(settings: ServiceSettings, owner: str) -> str:
    """The secret that an owner's webhooks are signed with; every owner has another."""
    key = place.made_once(settings.place / "webhook-key", lambda: secrets.token_bytes(32))
    return "whsec_" + b64encode(hmac.digest(key, owner.encode(), hashlib.sha256)).decode()


def check_url(url: str, allow_private: bool) -> httpx.URL:
    """What can be said without asking a name server. Raises RefusedAddress."""
    try:
        parsed = httpx.URL(url)
        host, port, _ = parsed.raw_host.decode("ascii"), parsed.port, parsed.host  # which reads its Punycode
    except (httpx.InvalidURL, ValueError) as error:  # UnicodeError is a ValueError
        raise RefusedAddress(f"no URL that can be followed: {error}") from None
    if parsed.scheme not in ("http", "https") or not host or parsed.userinfo or not 0 < (port or 80) < 1 << 16:
        raise RefusedAddress("a webhook is an http or https URL with a host and without a password")
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        _check_name(host, allow_private)
    else:
        if not allow_private:
            _refuse_private(address)
    return parsed


def _check_name(host: str, allow_private: bool) -> None:
    labels = host.removesuffix(".").lower().split(".")
    if len(host) > MAX_NAME or not all(_LABEL.fullmatch(label) for label in labels) or _NUMBER.fullmatch(labels[-1]):
        raise RefusedAddress(
            f"{host[:80]!r} is no host; allowed: a name of labels of 1 to 63 letters, digits and hyphens "
            f"whose last is no number, an IPv4 address of four decimal numbers, an IPv6 address in brackets"
        )
    if not allow_private and (len(labels) == 1 or labels[-1] in ("localhost", "local", "internal")):
        raise RefusedAddress(f"{host} names a private host")


def _refuse_private(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> None:
    found = _reached(address)
    if found is None or not found.is_global or found.is_multicast:
        raise RefusedAddress(f"{address} is a private address")


def _reached(
    address: ipaddress.IPv4Address | ipaddress.IPv6Address,
) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """The IPv4 address inside a translated or tunnelled one (RFC 6052, RFC 3056); None where it is no global unicast
    one."""
    if address.version == 4:
        return address
    if address.ipv4_mapped is not None:
        return address.ipv4_mapped
    if address in _NAT64:
        return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
    return (address.sixtofour or address) if address in _UNICAST else None


def _public_address(host: str, port: int, allow_private: bool) -> str:
    try:
        found = [str(info[4][0]) for info in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)]
    except (OSError, UnicodeError) as error:
        raise RefusedAddress(f"{host} has no address ({error})") from error
    for address in found if not allow_private else ():
        _refuse_private(ipaddress.ip_address(address.partition("%")[0]))
    return found[0]


def deliver_due(
    settings: ServiceSettings, store: Store, describe: Callable[[dict], dict], timeout_s: float = TIMEOUT_S
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
        next_due, level, message = _outcome(error, job["webhook_tries"])
        try:
            store.note_webhook(job["id"], job["attempt"], next_due)
            store.log(job["id"], level, message)
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


async def _deliver(job: dict, settings: ServiceSettings, describe: Callable[[dict], dict], timeout_s: float) -> None:
    url = check_url(job["webhook"], settings.webhook_private)
    host, port = url.raw_host.decode("ascii"), url.port or (443 if url.scheme == "https" else 80)
    now = datetime.now(UTC)
    body = json.dumps({"type": f"job.{job['status']}", "timestamp": now.isoformat(), "data": describe(job)})
    id = f"msg_{job['id']}_{job['attempt']}_{job['status']}"
    signature = Webhook(owner_secret(settings, job["owner"])).sign(id, now, body)
    headers = {
        "host": url.netloc.decode(),
        "content-type": "application/json",
        "webhook-id": id,
        "webhook-timestamp": str(int(now.timestamp())),
        "webhook-signature": signature,
    }
    async with asyncio.timeout(timeout_s):
        address = await asyncio.to_thread(_public_address, host, port, settings.webhook_private)
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
