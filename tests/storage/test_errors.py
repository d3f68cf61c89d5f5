import pickle

import pytest

from storage import errors
from storage.errors import InvalidPackedFile, SplatpressError

TREE = [error for error in SplatpressError.__subclasses__() if error.__module__ == errors.__name__]


def test_errors__tree_is_drawn_in_the_module():
    for error in TREE:
        line = next(line for line in errors.__doc__.splitlines() if error.__name__ in line)
        assert line.split()[-2:] == [error.kind, str(error.exit_code)]


@pytest.mark.parametrize("error", TREE)
def test_errors__survive_the_way_between_processes(error):
    sent = error("scan.ply", "radius -1", "positive", "give --radius")
    back = pickle.loads(pickle.dumps(sent))
    assert type(back) is error
    assert (back.where, back.found, back.allowed, back.hint) == ("scan.ply", "radius -1", "positive", "give --radius")
    assert str(back) == str(sent)


def test_errors__message_says_where_what_and_what_is_allowed():
    assert str(InvalidPackedFile("a", "b", "c", "d")) == "a: b; allowed: c; d"


def test_errors__message_leaves_out_what_is_not_known():
    assert str(InvalidPackedFile("a", "b")) == "a: b"
