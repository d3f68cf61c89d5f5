"""What a service answered, told from what another server answered."""

from __future__ import annotations

import json
from pathlib import PurePosixPath, PureWindowsPath

import httpx

from services.cli.exit_codes import ARGUMENTS, BY_KIND, INTERNAL
from storage.errors import SplatpressError

PROBLEM_JSON = "application/problem+json"
OF_THE_CALL = (401, 403, 404, 409)  # a token or an id that the service does not know, or what a job cannot do now


class ServiceError(SplatpressError):
    """What the service answered; `problem` is its RFC 9457 body."""

    def __init__(self, status: int, problem: dict) -> None:
        super().__init__(f"service answered {status}", problem.get("detail", ""), "", problem.get("hint", ""))
        self.status, self.problem = status, problem
        self.kind = problem.get("class", "internal")
        self.is_of_the_call = status in OF_THE_CALL and self.kind == "data"
        self.exit_code = ARGUMENTS if self.is_of_the_call else BY_KIND.get(self.kind, INTERNAL)

    @property
    def title(self) -> str:
        """What was asked for wrongly by its own name; nothing is wrong with a scan then."""
        return self.problem.get("title", "refused") if self.is_of_the_call else super().title

    def __reduce__(self):
        return type(self), (self.status, self.problem)


def check(answer: httpx.Response) -> None:
    """Raises ServiceError where the answer is no success."""
    if answer.is_success:
        return
    answer.read()
    problem = _parsed(answer)
    if answer.request.method == "HEAD":  # has no body by which to tell
        problem = {"detail": f"HEAD {answer.request.url.path}", "class": "resource"}
    elif not (isinstance(problem, dict) and "class" in problem):
        problem = _foreign(answer)
    raise ServiceError(answer.status_code, problem)


def document(answer: httpx.Response) -> dict:
    """The JSON of a success. Raises ServiceError where it has none: it is not this service that answered."""
    found = _parsed(answer)
    if not isinstance(found, dict):
        raise ServiceError(answer.status_code, _foreign(answer))
    return found


def _parsed(answer: httpx.Response):
    try:
        return json.loads(answer.content)
    except ValueError:
        return None


def _foreign(answer: httpx.Response) -> dict:
    kind = answer.headers.get("content-type", "nothing that it names").partition(";")[0]
    where = str(answer.request.url.copy_with(path="/", query=None, fragment=None))
    return {
        "detail": f"{where} is no splatpress service, or a proxy before it answered: {answer.status_code} with {kind}",
        "class": "resource",
        "hint": "check --url or SPLATPRESS_URL",
    }


def checked_name(name: str) -> str:
    """An artifact's name, which stays below the folder it is written to. Raises ServiceError for one that does not:
    what a server says is not to be trusted with this machine's files."""
    parts = name.split("/")
    absolute = PurePosixPath(name).is_absolute() or PureWindowsPath(name).drive or PureWindowsPath(name).root
    if absolute or "\\" in name or "\0" in name or {"", ".", ".."} & set(parts):
        raise ServiceError(
            502,
            {"detail": f"the service named an artifact {name[:200]!r}, which leaves the folder", "class": "resource"},
        )
    return name
