"""The table of knobs: a row each, and everything made from it."""

from __future__ import annotations

import argparse
import math
from dataclasses import fields

import pytest

from pipeline.planning.knobs import BY_NAME, KNOBS, VIEW_KNOBS, Knob
from pipeline.planning.settings import PRESETS, Settings, settings_for
from services.api.jobs import JobOptions
from services.api.published import get_options
from services.cli.arguments import add_settings, settings_of
from services.cli.parser import WrongArgument
from services.docs.knobs import PATH, document


def test_knobs__every_setting_has_one_row_in_order():
    assert [knob.name for knob in KNOBS] == [field.name for field in fields(Settings) if field.name != "preset"]


def test_knobs__every_row_says_what_it_buys_and_costs():
    assert all(knob.help and knob.buys and knob.costs and knob.stage for knob in KNOBS + VIEW_KNOBS)


@pytest.mark.parametrize("preset", PRESETS)
def test_knobs__every_preset_is_allowed(preset):
    assert settings_for(preset) == PRESETS[preset] and PRESETS[preset].preset == preset


def test_knobs__the_document_is_current():
    assert PATH.read_text() == document(), "write it again: python -m services.docs.knobs"


def test_knobs__command_line_and_options_have_every_row():
    parser = argparse.ArgumentParser()
    add_settings(parser)
    shown = parser.format_help()
    assert all(f"--{knob.name.replace('_', '-')}" in shown for knob in KNOBS)
    others = [knob.name for knob in KNOBS if knob.name != "seed"]
    assert [option["name"] for option in get_options()] == others == list(JobOptions.model_fields)


MIXED = Knob("mixed", int, "", "", "", "", choices=(8, 12, "auto"))
FREE = Knob("free", float, "", "", "", "", low=0.0, optional=True, above_low=True)
SPAN = Knob("span", int, "", "", "", "", low=1, high=5)


@pytest.mark.parametrize(
    ("knob", "text", "value"),
    [
        (MIXED, "8", 8),
        (MIXED, "auto", "auto"),
        (FREE, "1e-3", 0.001),
        (FREE, "7", 7.0),
        (SPAN, "1", 1),
        (SPAN, "5", 5),
    ],
)
def test_knobs__a_text_becomes_the_value_it_stands_for(knob, text, value):
    found = knob.parsed(text)
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    ("knob", "texts", "allowed"),
    [
        (MIXED, ("9", "8.0", "Auto", "", "0x8"), "allowed: 8, 12, auto"),
        (FREE, ("0", "-1", "nan", "inf", "x"), "allowed: above 0"),
        (SPAN, ("0", "6", "1.5", "1" * 5000), "allowed: whole numbers, 1 to 5"),
    ],
)
def test_knobs__a_text_that_stands_for_nothing_allowed_is_refused(knob, texts, allowed):
    for text in texts:
        with pytest.raises(ValueError, match=f"{knob.name} is .*; {allowed}"):
            knob.parsed(text)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("dictionary_bits", 8.0),
        ("dictionary_bits", True),
        ("iterations", "3"),
        ("iterations", True),
        ("target_psnr_db", math.nan),
        ("effects", 3),
        ("target_psnr_db", 80.5),
        ("radius", math.inf),
        ("seed", 2**63),
        ("max_atoms", -1),
        ("training_splats", 255),
    ],
)
def test_knobs__a_value_of_another_kind_or_out_of_range_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} is .*; allowed: "):
        settings_for(**{name: value})


def test_knobs__a_whole_number_for_a_real_one_is_the_same_setting():
    """So that the work of one is reused for the other."""
    assert repr(settings_for(target_psnr_db=41)) == repr(settings_for(target_psnr_db=41.0))


def test_knobs__an_unknown_setting_is_refused_by_name():
    with pytest.raises(ValueError, match="'atoms' is no setting; allowed: coder, atom_size, "):
        settings_for(atoms=3)


def test_knobs__arguments_become_settings():
    parser = argparse.ArgumentParser()
    add_settings(parser)
    found = settings_of(parser.parse_args(["--preset", "draft", "--dictionary-bits", "12", "--radius", "0.5"]))
    assert found == settings_for("draft", dictionary_bits=12, radius=0.5)
    with pytest.raises(WrongArgument, match="iterations is many; allowed: whole numbers, 1 to 1,000"):
        settings_of(parser.parse_args(["--iterations", "many"]))


def test_knobs__names_are_those_of_the_index():
    assert all(BY_NAME[knob.name] is knob for knob in KNOBS)


def test_knobs__effects_are_asked_for_one_by_one_or_as_a_list():
    parser = argparse.ArgumentParser()
    add_settings(parser)
    found = settings_of(parser.parse_args(["--effect", "depth_margin=on", "--effects", "all=auto,depth_margin=off"]))
    assert found == settings_for(effects=" depth_margin=off ,") and found.effects == "depth_margin=off"
    with pytest.raises(WrongArgument, match="'fog'; allowed: .*depth_margin"):
        settings_of(parser.parse_args(["--effect", "fog=on"]))
