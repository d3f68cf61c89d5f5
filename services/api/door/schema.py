"""What the OpenAPI document says beside what FastAPI finds: who may ask, and which methods a path has."""

from __future__ import annotations

from fastapi import FastAPI
from starlette.requests import Request
from starlette.routing import Match

_TUS_REQUEST = {
    "Tus-Resumable": ("post", "head", "patch", "delete"),
    "Upload-Length": ("post", "patch"),
    "Upload-Defer-Length": ("post",),
    "Upload-Metadata": ("post",),
    "Upload-Concat": ("post",),
    "Upload-Offset": ("patch",),
    "Upload-Checksum": ("post", "patch"),
}
_TUS_ANSWER = ("Tus-Resumable", "Upload-Offset", "Upload-Length", "Upload-Expires", "Upload-Concat", "Splatpress-Scan")
_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
_OPEN = ("/healthz", "/readyz", "/v1/schemas/{name}")  # ask for no token


def add_schema(app: FastAPI) -> None:
    """Let `app.openapi()` name the bearer token, the headers of tus, and the answers that every operation may give."""
    plain = app.openapi

    def openapi() -> dict:
        if app.openapi_schema is None:
            document = plain()
            bearer = {"type": "http", "scheme": "bearer", "description": "`splatpress token OWNER` makes one"}
            document.setdefault("components", {})["securitySchemes"] = {"token": bearer}
            document["security"] = [{"token": []}, {}]  # on loopback none is needed
            for path, operations in document["paths"].items():
                for method, operation in operations.items():
                    _complete(path, method, operation)
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def _complete(path: str, method: str, operation: dict) -> None:
    if path in _OPEN:
        operation["security"] = []
    operation.setdefault("responses", {})["5XX"] = {
        "description": "RFC 9457 problem details; `class` says whether it is the service's matter or a mistake of ours",
        "content": operation["responses"].get("4XX", {}).get("content", {}),
    }
    if not path.startswith("/v1/uploads"):
        return
    wanted = [name for name, methods in _TUS_REQUEST.items() if method in methods]
    needed = {"Tus-Resumable", *(["Upload-Offset"] if method == "patch" else [])}
    operation.setdefault("parameters", []).extend(
        {"name": name, "in": "header", "required": name in needed, "schema": {"type": "string"}} for name in wanted
    )
    if method in ("post", "patch"):
        content = {"application/offset+octet-stream": {"schema": {"type": "string", "format": "binary"}}}
        operation["requestBody"] = {"required": method == "patch", "content": content}
    for status, answer in operation["responses"].items():
        if status.startswith("2") and method != "get":
            answer["headers"] = {name: {"schema": {"type": "string"}} for name in _TUS_ANSWER}


def allowed_methods(request: Request) -> str:
    """Of the path that was asked for, in the form of the header Allow."""
    scope = {name: request.scope[name] for name in ("type", "path", "root_path", "headers", "query_string", "app")}

    def answers(method: str) -> bool:
        return any(route.matches({**scope, "method": method})[0] is Match.FULL for route in request.app.router.routes)

    found = {method for method in _METHODS if answers(method)}
    return ", ".join(sorted(found | ({"HEAD"} if "GET" in found else set())))
