"""Which wheels the locked packages have, a line each, for CPython 3.11 to 3.14 on Linux; reads a pylock.toml from
stdin.

`make lock` keeps what this prints as wheels.txt, and a test holds it against the lock file: no network in tests.
"""

from __future__ import annotations

import re
import sys
import tomllib

PYTHONS = ("311", "312", "313", "314")
LINUX = re.compile(r"(any|(manylinux|linux).*_(x86_64|aarch64))")


def fits(wheel: str) -> bool:
    """Whether one of those Pythons may take it, by the tags of its name (PEP 425)."""
    python, abi, platform = wheel.removesuffix(".whl").split("-")[-3:]
    if not any(LINUX.fullmatch(one) for one in platform.split(".")):
        return False
    if re.fullmatch(r"cp\d+t", abi):  # without the GIL
        return False
    pure = {"py3", "py2"} & set(python.split(".")) and abi == "none"
    return bool(pure or abi == "abi3" or any(f"cp{version}" in python.split(".") for version in PYTHONS))


def main() -> None:
    for package in tomllib.loads(sys.stdin.read())["packages"]:
        names = sorted(wheel["url"].rsplit("/", 1)[-1] for wheel in package.get("wheels", ()))
        print("\n".join(name for name in names if fits(name)))


if __name__ == "__main__":
    main()
