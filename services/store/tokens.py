"""Tokens of an owner: made, listed, revoked; and who did what. Only the hash of a token is kept."""

from __future__ import annotations

import hashlib
import hmac
import secrets
import time
from dataclasses import asdict

import sqlalchemy as sa

from services.store.rows import ActionRow, TokenRow
from services.store.tables import AUDIT, TOKENS

ID_LENGTH = 12  # of the hash's hexadecimal digits
NOTE_USE_S = 60.0


def token_hash(token: str) -> str:
    """What is kept of a token: its SHA-256, as hexadecimal digits."""
    return hashlib.sha256(token.encode()).hexdigest()


def add_token(store, owner: str, label: str = "", lasts_s: float | None = None) -> tuple[str, TokenRow]:
    """The token, which is told this once, and its row."""
    token, now = "sp_" + secrets.token_urlsafe(32), time.time()
    expires = now + lasts_s if lasts_s is not None else None
    row = TokenRow(token_hash(token), owner, now, label, expires, None)
    store._write(TOKENS.insert().values(asdict(row)))
    return token, row


def owner_of(store, token: str) -> str | None:
    """None for a token that is not known or no longer good."""
    mine, now = token_hash(token), time.time()
    row = store._one(TokenRow, sa.select(TOKENS).where(TOKENS.c.hash == mine))
    if row is None or not hmac.compare_digest(row.hash, mine) or (row.expires or now + 1) <= now:
        return None
    if now - (row.used or 0) > NOTE_USE_S:
        store._write(TOKENS.update().where(TOKENS.c.hash == mine).values(used=now))
    return row.owner


def tokens_of(store, owner: str) -> list[TokenRow]:
    """An owner's tokens, oldest first."""
    return store._all(TokenRow, sa.select(TOKENS).where(TOKENS.c.owner == owner).order_by(TOKENS.c.created))


def revoke_token(store, owner: str, id: str) -> bool:
    """Whether a token of the owner's began with this id, of ID_LENGTH digits or more; it is gone then."""
    mine = TOKENS.c.hash.startswith(id, autoescape=True) & (TOKENS.c.owner == owner)
    return len(id) >= ID_LENGTH and store._write(TOKENS.delete().where(mine)) == 1


def note_action(store, owner: str, action: str, target: str, client: str) -> None:
    """Write who did what into the log of deeds; texts are cut to what its columns hold."""
    row = {"time": time.time(), "owner": owner, "action": action[:40], "target": target[:100], "client": client[:100]}
    store._write(AUDIT.insert().values(row))


def actions_of(store, owner: str, limit: int, before: int | None = None) -> list[ActionRow]:
    """Newest first."""
    query = sa.select(AUDIT).where(AUDIT.c.owner == owner)
    query = query if before is None else query.where(AUDIT.c.id < before)
    return store._all(ActionRow, query.order_by(AUDIT.c.id.desc()).limit(limit))


def forget_actions(store, before: float) -> None:
    """Forget deeds from before a time."""
    store._write(AUDIT.delete().where(AUDIT.c.time < before))
