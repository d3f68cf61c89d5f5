"""/v1/tokens and /v1/audit: an owner's tokens, and what was done in his name."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Path, Query, Response
from pydantic import BaseModel, ConfigDict, Field

from services.api.context import Database, Owner
from services.jobs.documents import timestamp
from services.problems import Problem
from services.store.rows import TokenRow
from services.store.tokens import ID_LENGTH, actions_of, add_token, revoke_token, tokens_of

router = APIRouter(tags=["owners"])
DAY_S = 86_400


class TokenRequest(BaseModel):
    """What a token is made with."""

    model_config = ConfigDict(extra="forbid")

    label: str = Field("", max_length=100, pattern=r"^[^\x00-\x1f\x7f]*$")
    days: float | None = Field(None, gt=0, le=3650, description="how long it is good; for ever where it is left out")


def token_document(row: TokenRow) -> dict:
    """A token as the API shows it: never itself, but by its id."""
    times = {name: timestamp(getattr(row, name)) for name in ("created", "expires", "used")}
    return {"id": row.hash[:ID_LENGTH], "label": row.label, **times}


@router.get("/tokens")
def get_tokens(owner: Owner, store: Database) -> dict:
    """The caller's tokens, by their ids."""
    return {"tokens": [token_document(row) for row in tokens_of(store, owner)]}


@router.post("/tokens", status_code=201)
def post_token(request: TokenRequest, owner: Owner, store: Database) -> dict:
    """Another token of yours. `token` is told this once."""
    lasts_s = None if request.days is None else request.days * DAY_S
    token, row = add_token(store, owner, request.label, lasts_s)
    return {**token_document(row), "token": token}


@router.delete("/tokens/{id}", status_code=204)
def delete_token(
    id: Annotated[str, Path(pattern=f"^[0-9a-f]{{{ID_LENGTH}}}$")], owner: Owner, store: Database
) -> Response:
    """Revoke a token of the caller's."""
    if not revoke_token(store, owner, id):
        raise Problem(404, "no-such-token", f"no token {id}")
    return Response(status_code=204)


@router.get("/audit")
def get_audit(
    owner: Owner,
    store: Database,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    before: Annotated[int | None, Query(ge=0, le=1 << 31)] = None,
) -> dict:
    """What was changed in your name, newest first; `before` takes the last id of the page before."""
    rows = actions_of(store, owner, limit, before)
    return {
        "actions": [
            {**{k: v for k, v in asdict(row).items() if k != "owner"}, "time": timestamp(row.time)} for row in rows
        ]
    }
