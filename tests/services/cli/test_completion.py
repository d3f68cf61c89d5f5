"""Completion as the shell sees it."""

import re
import shutil
import subprocess

import pytest

from services.cli.main import main
from services.cli.parser import Commands

BASH = """
source /dev/stdin
ask() { COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=(); _splatpress; echo "${COMPREPLY[@]}"; }
ask splatpress comp
ask splatpress compress scan --pres
ask splatpress compress scan --executor ""
ask splatpress compress sc
"""


def script(capsys, shell: str) -> str:
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


def test_completion__bash_has_commands_options_and_choices_and_leaves_files_to_the_shell(capsys):
    found = subprocess.run(["bash", "-c", BASH], input=script(capsys, "bash"), capture_output=True, text=True)
    assert found.stderr == ""
    assert found.stdout.splitlines() == ["completion compress", "--preset", "dask serial", ""]


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_completion__other_shells_take_their_script(capsys, shell):
    text = script(capsys, shell)
    assert "compress" in text and "executor" in text
    if shutil.which(shell):
        assert subprocess.run([shell, "-n"], input=text, text=True).returncode == 0


@pytest.mark.parametrize("name", list(Commands()))
def test_completion__every_option_that_help_names_is_one_that_is_taken(name):
    parser = Commands()[name]
    taken = {option for action in parser.added for option in action.option_strings} | {"--help"}
    assert set(re.findall(r"(?<![\w-])--[a-z0-9-]+", parser.format_usage())) <= taken
