"""The job page at `/`: plain files, served as they are."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter, Response
from fastapi.responses import FileResponse

from services.api.context import Owner, Settings
from services.jobs.heartbeat import dashboard
from services.problems import Problem
from services.web.viewer_page import PAGE, POLICY, viewer_file

router = APIRouter(include_in_schema=False)
_FOLDER = Path(__file__).parent.parent / "web"
_FILES = ("page.js", "ask.js", "job.js", "uploads.js", "page.css", "docs.html", "docs.js", "account.js")


@router.get("/")
def get_page() -> FileResponse:
    """The job page."""
    return FileResponse(_FOLDER / "index.html")


@router.get("/docs")
def get_docs() -> FileResponse:
    """The API's documentation, made in the browser from the OpenAPI document."""
    return FileResponse(_FOLDER / "docs.html")


@router.get("/view")
def get_viewer() -> Response:
    """The viewer; its address says which artifact it is to show."""
    contents, media_type = viewer_file(PAGE)
    return Response(contents, media_type=media_type, headers={"content-security-policy": POLICY})


@router.get("/web/viewer/{name}")
def get_viewer_file(name: str) -> Response:
    """A file of the viewer."""
    found = viewer_file(name)
    if found is None:
        raise Problem(404, "not-found", f"no file {name!r}")
    return Response(found[0], media_type=found[1])


@router.get("/web/{name}")
def get_file(name: str) -> FileResponse:
    """A file of the job page."""
    if name not in _FILES:
        raise Problem(404, "not-found", f"no file {name!r}")
    return FileResponse(_FOLDER / name)


@router.get("/web-state")
def get_state(owner: Owner, settings: Settings) -> dict:
    """What the page shows beside the API's own answers."""
    return {"owner": owner, "dashboard": bool(settings.dashboard_url or dashboard(settings.place))}
