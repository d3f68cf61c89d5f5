"""The web application: routes under /v1, health, metrics, and the job page."""

from __future__ import annotations

import sys
import traceback

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import InterfaceError, OperationalError
from starlette.exceptions import HTTPException

from services.api import (
    artifacts,
    dashboard,
    estimates,
    events,
    health,
    jobs,
    ogc,
    owners,
    page,
    published,
    scans,
    uploads,
)
from services.api.context import owner_of
from services.api.door.body import MAX_JSON_BYTES, MULTIPART_OVERHEAD, BodyGuard, Guard, cap, first_look, room
from services.api.door.head import Head
from services.api.door.schema import add_schema, allowed_methods
from services.api.door.secured import Secured
from services.api.door.turns import FilesInTurn
from services.problems import RESOURCE, Problem, is_of_database, mistake
from services.settings import ServiceSettings
from services.store.store import Store
from storage.place.objects import OBJECT_STORE
from storage.version import VERSION

PROBLEM_JSON = "application/problem+json"
_PROBLEM = {
    "description": "RFC 9457 problem details",
    "content": {
        PROBLEM_JSON: {
            "schema": {
                "type": "object",
                "required": ["type", "title", "status", "detail", "class", "retryable"],
                "properties": {
                    "type": {"type": "string"},
                    "title": {"type": "string"},
                    "status": {"type": "integer"},
                    "detail": {"type": "string"},
                    "class": {"enum": ["data", "resource", "internal"]},
                    "retryable": {"type": "boolean"},
                    "hint": {"type": "string"},
                },
            }
        }
    },
}


def create_app(settings: ServiceSettings) -> FastAPI:
    """The application of a service with these settings, on its database."""
    app = FastAPI(
        title="splatpress",
        version=VERSION,
        docs_url=None,
        redoc_url=None,
        openapi_url="/v1/openapi.json",
        description="Turns textured scans into small packed files that a GPU renders directly.",
        responses={"4XX": _PROBLEM},
    )
    app.state.settings, app.state.store = settings, Store(settings.database_url)
    for module in (scans, uploads, estimates, ogc, jobs, events, artifacts, published, owners):
        app.include_router(module.router, prefix="/v1")
    app.include_router(health.router)
    app.include_router(page.router)
    app.include_router(dashboard.router)
    app.add_exception_handler(Problem, _problem)  # type: ignore[arg-type]
    app.add_exception_handler(RequestValidationError, _invalid)  # type: ignore[arg-type]
    app.add_exception_handler(HTTPException, _http)  # type: ignore[arg-type]
    for away in (OperationalError, InterfaceError):
        app.add_exception_handler(away, _database)
    app.add_exception_handler(OSError, _objects)  # type: ignore[arg-type]
    app.add_exception_handler(Exception, _mistake)
    app.add_middleware(
        BodyGuard,
        admit=owner_of,  # type: ignore[arg-type]
        guards=lambda *request: _guards(settings, *request),
        idle_s=settings.body_idle_s,  # type: ignore[arg-type]
    )
    app.add_middleware(Head)
    app.add_middleware(Secured)
    app.add_middleware(FilesInTurn)
    add_schema(app)
    return app


def _guards(settings: ServiceSettings, method: str, path: str, promised: int) -> list[Guard]:
    if method in ("PATCH", "POST") and path.startswith("/v1/uploads"):
        return []  # counts and looks by itself
    if path == "/v1/scans":
        return [
            cap(settings.max_multipart_bytes + MULTIPART_OVERHEAD, promised),
            room(settings, promised),
            first_look(settings, promised),
        ]
    return [cap(MAX_JSON_BYTES, promised)]


def _answer(problem: Problem) -> JSONResponse:
    return JSONResponse(problem.body(), problem.status, problem.headers, PROBLEM_JSON)


async def _problem(_: Request, problem: Problem) -> JSONResponse:
    return _answer(problem)


async def _invalid(_: Request, error: RequestValidationError) -> JSONResponse:
    found = "; ".join(f"{'.'.join(str(part) for part in e['loc'])}: {e['msg']}" for e in error.errors()[:5])
    return _answer(Problem(422, "invalid-request", found))


async def _http(request: Request, error: HTTPException) -> JSONResponse:
    if error.status_code == 405:
        error.headers = {**(error.headers or {}), "Allow": allowed_methods(request)}
    slug = {404: "not-found", 405: "method-not-allowed", 400: "bad-request"}.get(error.status_code, "http-error")
    return _answer(Problem(error.status_code, slug, str(error.detail), headers=dict(error.headers or {})))


async def _database(_: Request, error: Exception) -> JSONResponse:
    if is_of_database(error, full=True):
        return _answer(Problem(507, "disk-full", "no room for the database", kind=RESOURCE, retryable=True))
    return _answer(
        Problem(
            503,
            "database-away",
            "the database does not answer",
            kind=RESOURCE,
            retryable=True,
            headers={"Retry-After": "5"},
        )
    )


async def _objects(request: Request, error: OSError) -> JSONResponse:
    if not (error.strerror or "").startswith(OBJECT_STORE):
        return await _mistake(request, error)
    print(f"splatpress: {error}", file=sys.stderr, flush=True)
    detail = "the object store does not answer, has no such bucket, or refuses the service's keys"
    return _answer(Problem(503, "objects-away", detail, kind=RESOURCE, retryable=True, headers={"Retry-After": "5"}))


async def _mistake(request: Request, error: Exception) -> JSONResponse:
    return _answer(mistake(f"{request.method} {request.url.path}: {''.join(traceback.format_exception(error))}"))
