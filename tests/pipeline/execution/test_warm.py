"""What a worker has done before its first task."""

import logging

import pipeline.warm  # noqa: F401


def test_warm__a_heartbeat_that_finds_no_scheduler_is_told_by_no_stack_trace(caplog):
    logger = logging.getLogger("distributed.worker")
    with caplog.at_level(logging.ERROR, logger.name):
        logger.propagate, before = True, logger.propagate
        logger.error("Failed to communicate with scheduler during heartbeat.")
        logger.error("Event loop was unresponsive")
        logger.propagate = before
    assert [record.getMessage() for record in caplog.records] == ["Event loop was unresponsive"]
