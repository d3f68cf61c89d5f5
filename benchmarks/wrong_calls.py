"""How long wrong calls and wrong files take to be refused, each by a program of its own, as a user starts it.

    python -m benchmarks.wrong_calls

The calls and files are those of the tests (tests/services/cli/test_wrong_calls.py, test_wrong_files.py), which hold
their exit codes and words; printed from the slowest on: seconds of a processor, which other programs lengthen little,
and seconds from its start to its end.
"""

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.needs import packages_of_tests


def processor_seconds() -> float:
    """Seconds of a processor that programs started from here, and ended, have taken in all."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def seconds(arguments: list[str], expected: int) -> tuple[float, float]:
    """Seconds of a processor and of the clock that `splatpress ARGUMENTS` takes; raises ValueError where it ends
    otherwise than with `expected`."""
    start, used = time.perf_counter(), processor_seconds()
    ended = subprocess.run([sys.executable, "-m", "services.cli.main", *arguments], capture_output=True, text=True)
    taken = processor_seconds() - used, time.perf_counter() - start
    if ended.returncode != expected:
        raise ValueError(f"splatpress {' '.join(arguments)}: exit {ended.returncode}, not {expected}: {ended.stderr}")
    return taken


def main() -> None:
    with packages_of_tests():
        from tests.services.cli.test_wrong_calls import CALLS, places_in
        from tests.services.cli.test_wrong_files import FILES

    taken: list[tuple[tuple[float, float], str]] = []
    with tempfile.TemporaryDirectory(prefix="falsche Aufrufe ") as name:
        folder = Path(name)
        places = places_in(folder)
        for call, code, _ in CALLS:
            taken.append((seconds([part.format(**places) for part in call.split()], code), call or "(nothing)"))
        for file, data, code, _ in FILES:
            (folder / file).write_bytes(data)
            call = ["compress", str(folder / file), "--out", str(folder / "out")]
            taken.append((seconds(call, code), f"compress {file}"))
    print("processor    clock")
    for (processor, clock), call in sorted(taken, reverse=True):
        print(f"{processor:7.2f} s {clock:6.2f} s  {call}")
    for k, name in enumerate(("of a processor", "of the clock")):
        print(f"{len(taken)} calls, {sum(one[k] > 2 for one, _ in taken)} above 2 s {name}")


if __name__ == "__main__":
    main()
