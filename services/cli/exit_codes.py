"""What the command line ends with. `storage.errors` has those of its errors; these are the same numbers by name."""

from __future__ import annotations

OK = 0
ARGUMENTS = 1
INPUT_OUTPUT = 2  # also resources
INVALID_INPUT = 3
INTERNAL = 4  # a mistake of ours
UNSUPPORTED = 5
GATE_MISSED = 7  # a quality gate
INTERRUPTED, TERMINATED = 130, 143  # as shells have them: 128 and SIGINT, SIGTERM
BY_KIND = {"data": INVALID_INPUT, "resource": INPUT_OUTPUT, "internal": INTERNAL}  # of an error's `kind`
