"""argparse as users of a large command line want it: one line an error, with the name that was probably meant."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterable, Iterator
from importlib import import_module

from services.cli.commands import COMMANDS
from services.cli.exit_codes import ARGUMENTS

PROGRAM = "splatpress"
EXAMPLES = """examples:
  splatpress compress "my scan.las" --out OUT          # OUT/my scan.splatpress, report.html, previews/
  splatpress estimate SCAN --preset high               # before: seconds, memory, bytes, PSNR
  splatpress render OUT/SCAN.splatpress --orbit 8 --out PICTURES
  splatpress COMMAND --help                            # all options of a command
"""


class WrongArgument(ValueError):
    """A value that argparse itself cannot tell to be wrong; the command line ends with exit code 1."""


class Parser(argparse.ArgumentParser):
    """Wrong arguments exit with 1, after one line that says what is allowed. `added` has all arguments."""

    def __init__(self, prog: str, **how) -> None:
        self.added: list[argparse.Action] = []
        super().__init__(prog, **how)

    def add_argument(self, *names, **how) -> argparse.Action:
        """As argparse."""
        return self._remembered(super().add_argument(*names, **how))

    def add_mutually_exclusive_group(self, **how):
        """As argparse."""
        group = super().add_mutually_exclusive_group(**how)
        add = group.add_argument
        group.add_argument = lambda *names, **options: self._remembered(add(*names, **options))  # type: ignore[method-assign]
        return group

    def refuse_unknown(self, given: list[str]) -> None:
        """Ends where an option does not exist; argparse alone would tell missing arguments first."""
        known = [option for action in self.added for option in action.option_strings]
        for word in given[: given.index("--")] if "--" in given else given:
            name = word.partition("=")[0]
            if name.startswith("--") and not any(option.startswith(name) for option in known):
                from difflib import get_close_matches

                close = get_close_matches(name, known, 1)
                self.error(f"there is no option {name}" + (f"; did you mean {close[0]}?" if close else ""))

    def error(self, message: str):
        self.exit(ARGUMENTS, f"{self.prog}: {_with_suggestion(message)}; see {self.prog} --help\n")

    def _remembered(self, action: argparse.Action) -> argparse.Action:
        self.added.append(action)
        return action


class Commands:
    """The parsers of commands, each made when it is asked for, by the function that the table names."""

    def __init__(self) -> None:
        self._parsers: dict[str, Parser] = {}
        self._adds = {name: add for rows in COMMANDS.values() for name, (add, _) in rows.items()}

    def __iter__(self) -> Iterator[str]:
        return iter(self._adds)

    def __getitem__(self, name: str) -> Parser:
        if name not in self._parsers:
            module, _, function = self._adds[name].partition(":")
            getattr(import_module(f"services.cli.commands.{module}"), function)(self)
        return self._parsers[name]

    def add_parser(self, name: str, **how) -> Parser:
        """What a command's function calls, and adds its arguments to."""
        self._parsers[name] = Parser(f"{PROGRAM} {name}", **how)
        return self._parsers[name]

    def parsed(self, given: list[str] | None = None) -> argparse.Namespace:
        """What a call says; its `command` is the function to call with it. A wrong call, --help and --version raise
        SystemExit, as argparse does."""
        given = sys.argv[1:] if given is None else given
        if not given or given[0] not in self._adds:
            given = [_Program(self._adds).parse_args(given).command]
        parser = self[given[0]]
        parser.refuse_unknown(given[1:])
        return parser.parse_args(given[1:])


class _Version(argparse.Action):
    """Prints the version, which no other call has to look up."""

    def __call__(self, parser, *_) -> None:
        from storage.version import VERSION

        print(f"{PROGRAM} {VERSION}")
        parser.exit()


class _Program(Parser):
    """What is no command's: --help, --version, and a word that is no command."""

    def __init__(self, names: Iterable[str]) -> None:
        super().__init__(PROGRAM, description="Turns textured scans into small packed files that a GPU renders.")
        self.add_argument("--version", action=_Version, nargs=0)
        self.add_argument("command", metavar="COMMAND", choices=list(names))

    def format_help(self) -> str:
        lines = [f"usage: {PROGRAM} [--help] [--version] COMMAND ...", "", self.description or ""]
        for title, rows in COMMANDS.items():
            lines += ["", f"{title}:", *(f"  {name:<11}{text}" for name, (_, text) in rows.items())]
        return "\n".join([*lines, "", EXAMPLES])


def _with_suggestion(message: str) -> str:
    """argparse's message of a wrong choice names all; the nearest is named first.

    >>> _with_suggestion("argument COMMAND: invalid choice: 'comprss' (choose from 'compress', 'check')")
    "argument COMMAND: invalid choice: 'comprss'; did you mean 'compress'? (choose from 'compress', 'check')"
    """
    found = re.fullmatch(r"(.*invalid choice: '([^']*)') (\(choose from (.*)\))", message, re.DOTALL)
    if found is None:
        return message
    from difflib import get_close_matches

    close = get_close_matches(found[2], re.findall(r"[\w.-]+", found[4]), 1)
    return f"{found[1]}; did you mean {close[0]!r}? {found[3]}" if close else message
