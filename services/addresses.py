"""Which addresses strangers may have this service ask: public ones alone.

A name is resolved once, every address it has must be public, and the connection goes to that very address, so that a
second answer of the name server leads nowhere.
"""

from __future__ import annotations

import ipaddress
import re
import socket

import httpx

MAX_NAME = 253
_LABEL = re.compile(r"[a-z0-9_]([a-z0-9_-]{0,61}[a-z0-9_])?")
_NUMBER = re.compile(r"[0-9]+|0x[0-9a-f]*")  # a host that ends in one is an IPv4 address (WHATWG URL, 3.5)
_UNICAST = ipaddress.ip_network("2000::/3")  # all global IPv6 addresses are from here, but for those of NAT64
_NAT64 = ipaddress.ip_network("64:ff9b::/96")


class RefusedAddress(Exception):
    """A URL that leads into a private network, or whose name leads nowhere."""


def check_url(url: str, allow_private: bool) -> httpx.URL:
    """What can be said without asking a name server. Raises RefusedAddress."""
    try:
        parsed = httpx.URL(url)
        host, port, _ = parsed.raw_host.decode("ascii"), parsed.port, parsed.host  # which reads its Punycode
    except (httpx.InvalidURL, ValueError) as error:  # UnicodeError is a ValueError
        raise RefusedAddress(f"no URL that can be followed: {error}") from None
    if parsed.scheme not in ("http", "https") or not host or parsed.userinfo or not 0 < (port or 80) < 1 << 16:
        raise RefusedAddress("allowed: an http or https URL with a host and without a password")
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


def public_address(host: str, port: int, allow_private: bool) -> str:
    """The address to connect to. Raises RefusedAddress where the name has none, or one that is private."""
    try:
        found = [str(info[4][0]) for info in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)]
    except (OSError, UnicodeError) as error:
        raise RefusedAddress(f"{host} has no address ({error})") from error
    for address in found if not allow_private else ():
        _refuse_private(ipaddress.ip_address(address.partition("%")[0]))
    return found[0]
