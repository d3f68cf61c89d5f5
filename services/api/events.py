"""/v1/jobs/{id}/events: server-sent events with ids, replayed from Last-Event-ID on; the log that they are read from
is the one that the runner writes."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Header, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse

from services.api.context import Database, Job
from services.jobs.documents import timestamp
from services.store.rows import LIVE
from services.store.store import Store

router = APIRouter(tags=["jobs"])
POLL_S = 0.5
KEEP_ALIVE_S = 15.0


@router.get(
    "/jobs/{id}/events",
    response_class=StreamingResponse,
    responses={200: {"content": {"text/event-stream": {}}, "description": "server-sent events"}},
)
async def get_events(
    job: Job,
    store: Database,
    request: Request,
    last_event_id: Annotated[str | None, Header(pattern="^[0-9]{1,9}$")] = None,
) -> StreamingResponse:
    """status, progress, learning and log events; ends after the event that says how the job ended."""
    stream = _events(job.id, int(last_event_id or 0), store, request)
    return StreamingResponse(
        stream, media_type="text/event-stream", headers={"cache-control": "no-store", "x-accel-buffering": "no"}
    )


async def _events(job: str, after: int, store: Store, request: Request) -> AsyncIterator[str]:
    quiet = 0.0
    while not await request.is_disconnected():
        row = await run_in_threadpool(store.job, job)  # read before the events: none can come after its end
        rows = await run_in_threadpool(store.events, job, after)
        for event in rows:
            after = event.id
            data = json.dumps({"time": timestamp(event.time), **event.data})
            yield f"id: {after}\nevent: {event.kind}\ndata: {data}\n\n"
        if not rows and (row is None or row.status not in LIVE):
            return
        quiet = 0.0 if rows else quiet + POLL_S
        if quiet >= KEEP_ALIVE_S:
            quiet = 0.0
            yield ": still here\n\n"
        if not rows:
            await asyncio.sleep(POLL_S)
