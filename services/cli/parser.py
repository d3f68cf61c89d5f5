"""argparse as users of a large command line want it: one line an error, with the name that was probably meant."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from typing import NoReturn

from services.cli.exit_codes import ARGUMENTS

GROUPS = {
    "a scan": ("compress", "inspect", "check", "tradeoff", "estimate", "effects", "evaluate", "iso", "map", "demo"),
    "a packed file": ("render", "coverage", "report", "view", "export", "pages", "path", "fly"),
    "how large, how long": ("plan",),
    "the shell": ("completion",),
    "the service": ("serve", "api", "runner", "token", "backup", "restore"),
    "a service's user": (
        "login", "logout", "upload", "submit", "watch", "status", "cancel", "retry", "logs", "fetch", "ls", "regress",
    ),
}  # fmt: skip
EXAMPLES = """examples:
  splatpress compress "my scan.las" --out OUT          # OUT/my scan.splatpress, report.html, previews/
  splatpress estimate SCAN --preset high               # before: seconds, memory, bytes, PSNR
  splatpress render OUT/SCAN.splatpress --orbit 8 --out PICTURES
  splatpress COMMAND --help                            # all options of a command
"""


class Parser(argparse.ArgumentParser):
    """Wrong arguments exit with 1, after one line that says what is allowed."""

    def parse_args(self, args: Sequence[str] | None = None, namespace=None):  # type: ignore[override]
        """As argparse; an option that does not exist is told before arguments that are missing."""
        given = list(sys.argv[1:] if args is None else args)
        parser = self._parser_of(given)
        options = given[: given.index("--")] if "--" in given else given
        for word in options if parser is not self else ():
            name, known = word.partition("=")[0], parser._option_string_actions
            if name.startswith("--") and not any(option.startswith(name) for option in known):
                from difflib import get_close_matches

                close = get_close_matches(name, known, 1)
                parser.error(f"there is no option {name}" + (f"; did you mean {close[0]}?" if close else ""))
        return super().parse_args(given, namespace)

    def error(self, message: str) -> NoReturn:
        self.exit(ARGUMENTS, f"{self.prog}: {_with_suggestion(message)}; see {self.prog} --help\n")

    def format_help(self) -> str:
        commands = self._commands()
        if not commands:
            return super().format_help()
        helps = {action.dest: action.help for action in self._subparser_actions()[0]._choices_actions}
        grouped = {title: [name for name in names if name in commands] for title, names in GROUPS.items()}
        others = [name for name in commands if not any(name in names for names in GROUPS.values())]
        lines = [f"usage: {self.prog} [--help] [--version] COMMAND ...", "", self.description or ""]
        for title, names in [*grouped.items(), ("others", others)]:
            if names:
                lines += ["", f"{title}:", *(f"  {name:<11}{helps.get(name) or ''}" for name in names)]
        return "\n".join([*lines, "", EXAMPLES])

    def _parser_of(self, given: list[str]) -> Parser:
        """The parser of the command that is asked for."""
        commands = self._commands()
        return next((commands[word] for word in given if word in commands), self)

    def _commands(self) -> dict[str, Parser]:
        return {name: parser for action in self._subparser_actions() for name, parser in action.choices.items()}

    def _subparser_actions(self) -> list[argparse._SubParsersAction]:
        return [action for action in self._actions if isinstance(action, argparse._SubParsersAction)]


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
