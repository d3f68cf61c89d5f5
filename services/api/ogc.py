"""OGC API - Processes, part 1: what clients of that standard ask for beside /v1/jobs, which is its job list.

A process is executed asynchronously; its inputs are the fields of a job's request, by the same names.

References: OGC 18-062r2, 7.2 (landing page), 7.4 (conformance), 7.9 to 7.13 (processes, execution, results).
"""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Path, Request, Response
from fastapi.encoders import jsonable_encoder
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from services.api.context import Database, Job, Owner, Settings
from services.api.jobs import IdempotencyKey, JobRequest, post_job
from services.problems import Problem
from services.processes.kinds import COMPRESS, PROCESSES, TRADEOFF
from services.store.rows import LIVE, SUCCESSFUL
from storage.version import VERSION

router = APIRouter(tags=["processes"])
_REL = "http://www.opengis.net/def/rel/ogc/1.0/"
_CONFORMS = "http://www.opengis.net/spec/ogcapi-processes-1/1.0/conf/"
_CLASSES = ("core", "ogc-process-description", "json", "job-list", "dismiss")
_ABOUT = {
    COMPRESS: (
        "Compress a scan",
        "One packed file that a GPU renders directly, previews and a report of what was lost.",
    ),
    TRADEOFF: ("What another decibel costs", "Presets and each knob alone, measured on a scan: bytes, seconds, PSNR."),
}
_INPUTS = {COMPRESS: ("scan", "preset", "options", "seed", "name"), TRADEOFF: ("knobs", "budget_s")}
_KINDS = {
    ".splatpress": "application/octet-stream",
    ".html": "text/html",
    ".json": "application/json",
    ".png": "image/png",
}
ProcessID = Annotated[str, Path(max_length=40)]


class Execute(BaseModel):
    """`outputs` and `response` are taken and change nothing: results are always documents that name every artifact."""

    model_config = ConfigDict(extra="forbid")

    inputs: dict[str, object] = Field(default_factory=dict, max_length=20)
    outputs: dict[str, object] = Field(default_factory=dict, max_length=100)
    response: Literal["raw", "document"] = "document"


def _link(rel: str, href: str, kind: str = "application/json") -> dict:
    return {"rel": rel, "href": href, "type": kind}


@router.get("/")
def get_landing_page() -> dict:
    """Where everything is, by OGC API - Processes."""
    return {
        "title": "splatpress",
        "description": "Turns textured scans into small packed files that a GPU renders directly.",
        "links": [
            _link("self", "/v1/"),
            _link("service-desc", "/v1/openapi.json", "application/vnd.oai.openapi+json;version=3.1"),
            _link("service-doc", "/docs", "text/html"),
            _link(_REL + "conformance", "/v1/conformance"),
            _link(_REL + "processes", "/v1/processes"),
            _link(_REL + "job-list", "/v1/jobs"),
        ],
    }


@router.get("/conformance")
def get_conformance() -> dict:
    """The conformance classes that the service meets."""
    return {"conformsTo": [_CONFORMS + name for name in _CLASSES]}


@router.get("/processes")
def get_processes() -> dict:
    """The kinds of job that there are."""
    return {"processes": [_summary(id) for id in PROCESSES], "links": [_link("self", "/v1/processes")]}


@router.get("/processes/{id}")
def get_process(id: ProcessID) -> dict:
    """Inputs with their schemas; what each option buys and costs says `GET /v1/options`."""
    _check_process(id)
    schema = JobRequest.model_json_schema(ref_template="#/components/schemas/{model}")
    names = _INPUTS[COMPRESS] + (_INPUTS[TRADEOFF] if id == TRADEOFF else ())
    inputs = {
        name: {
            "title": name,
            "minOccurs": int(name in schema["required"]),
            "maxOccurs": 1,
            "schema": _resolved(schema["properties"][name], schema.get("$defs", {})),
        }
        for name in names
    }
    outputs = {"artifacts": {"title": "every file that the job made, by name", "schema": {"type": "object"}}}
    return {**_summary(id), "inputs": inputs, "outputs": outputs}


def _resolved(schema: dict, definitions: dict) -> dict:
    name = schema.get("$ref", "").rpartition("/")[2]
    return {**definitions[name], **{k: v for k, v in schema.items() if k != "$ref"}} if name else schema


def _summary(id: str) -> dict:
    title, description = _ABOUT[id]
    return {
        "id": id,
        "title": title,
        "description": description,
        "version": VERSION,
        "jobControlOptions": ["async-execute", "dismiss"],
        "outputTransmission": ["reference"],
        "links": [
            _link("self", f"/v1/processes/{id}"),
            _link(_REL + "execute", f"/v1/processes/{id}/execution"),
        ],
    }


def _check_process(id: str) -> None:
    if id not in PROCESSES:
        raise Problem(404, "no-such-process", f"no process {id!r}; allowed: {', '.join(PROCESSES)}")


@router.post("/processes/{id}/execution", status_code=201)
def post_execution(
    id: ProcessID,
    execute: Execute,
    request: Request,
    response: Response,
    owner: Owner,
    settings: Settings,
    store: Database,
    idempotency_key: IdempotencyKey = None,
) -> dict:
    """Submit a job, whose statusInfo is the answer; its address is Location."""
    _check_process(id)
    try:
        wanted = JobRequest(**{**execute.inputs, "process": id})  # type: ignore[arg-type]
    except ValidationError as error:
        found = [{**e, "loc": ("body", "inputs", *e["loc"])} for e in error.errors(include_url=False)]
        raise RequestValidationError(jsonable_encoder(found, custom_encoder={Exception: str})) from None
    if "respond-async" in request.headers.get("prefer", ""):
        response.headers["Preference-Applied"] = "respond-async"
    return post_job(wanted, response, owner, settings, store, idempotency_key)


@router.get("/jobs/{id}/results")
def get_results(job: Job, store: Database) -> dict:
    """References to all that a job made, by name; 404 while it is under way, and where it failed what failed."""
    if job.status in LIVE:
        raise Problem(404, "result-not-ready", f"job {job.id} is {job.status}", retryable=True)
    if job.status != SUCCESSFUL:
        problem = job.problem or {"detail": f"job {job.id} was dismissed", "class": "data", "status": 410}
        raise Problem(problem["status"], "job-" + job.status, problem["detail"], kind=problem["class"])
    rows = store.artifacts(job.id)
    base = f"/v1/jobs/{job.id}/artifacts/"
    return {row.name: {"href": base + row.name, "type": _kind(row.name)} for row in rows}


def _kind(name: str) -> str:
    return _KINDS.get("." + name.rpartition(".")[2], "application/octet-stream")
