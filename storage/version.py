"""The version of the program: that of pyproject.toml, as it is installed."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

try:
    VERSION = version("splatpress")
except PackageNotFoundError:  # run from a folder that nobody installed
    VERSION = "unknown"
