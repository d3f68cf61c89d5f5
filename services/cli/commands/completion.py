"""`splatpress completion SHELL`: a script that lets a shell complete commands, options and their choices."""

from __future__ import annotations

import argparse

from services.cli.exit_codes import OK
from services.cli.parser import Parser

SHELLS = ("bash", "zsh", "fish")
HOW = """\
how:
  bash:  splatpress completion bash >~/.local/share/bash-completion/completions/splatpress
  zsh:   echo 'source <(splatpress completion zsh)' >>~/.zshrc
  fish:  splatpress completion fish >~/.config/fish/completions/splatpress.fish
"""


def add_completion(commands) -> None:
    """The verb; it completes all that `commands` has."""
    completion = commands.add_parser(
        "completion",
        epilog=HOW,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    completion.add_argument("shell", choices=SHELLS)
    completion.set_defaults(command=lambda options: _completion(options, {name: commands[name] for name in commands}))


def _completion(options: argparse.Namespace, parsers: dict[str, Parser]) -> int:
    print(_fish(parsers) if options.shell == "fish" else _bash(parsers, zsh=options.shell == "zsh"))
    return OK


def _options_of(parser: Parser) -> list[argparse.Action]:
    return [a for a in parser.added if a.option_strings and a.help != argparse.SUPPRESS]


def _bash(parsers: dict[str, Parser], zsh: bool) -> str:
    """A function that looks at the command, then at the option before the word; where it knows nothing, files."""
    lines = ["autoload -U +X bashcompinit && bashcompinit"] if zsh else []
    lines += [
        "_splatpress() {",
        '    local word=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD - 1]} words=""',
        f'    if [ "$COMP_CWORD" = 1 ]; then words="{" ".join(sorted(parsers))} --help --version"; else',
        '    case "${COMP_WORDS[1]} $before" in',
    ]
    for name, parser in sorted(parsers.items()):
        for action in _options_of(parser):
            if action.choices:
                of = " | ".join(f"'{name} {option}'" for option in action.option_strings)
                lines.append(f'    {of}) words="{" ".join(map(str, action.choices))}" ;;')
    lines += ['    *) case "$word" in -*) case "${COMP_WORDS[1]}" in']
    for name, parser in sorted(parsers.items()):
        options = " ".join(option for a in _options_of(parser) for option in a.option_strings if option[:2] == "--")
        lines.append(f'        {name}) words="{options}" ;;')
    lines += [
        "    esac ;; esac ;;",
        "    esac; fi",
        '    COMPREPLY=($(compgen -W "$words" -- "$word"))',
        "}",
        "complete -o default -F _splatpress splatpress",
    ]
    return "\n".join(lines)


def _fish(parsers: dict[str, Parser]) -> str:
    lines = []
    for name, parser in sorted(parsers.items()):
        lines.append(f"complete -c splatpress -n __fish_use_subcommand -f -a {name}")
        for action in _options_of(parser):
            for option in (option for option in action.option_strings if option[:2] == "--"):
                chosen = f" -x -a '{' '.join(map(str, action.choices))}'" if action.choices else ""
                takes = " -r" if action.nargs is None and not chosen else ""
                lines.append(
                    f"complete -c splatpress -n '__fish_seen_subcommand_from {name}' -l {option[2:]}{takes}{chosen}"
                )
    return "\n".join(lines)
