import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.catalogue import CATALOGUE, RENDER, SHARES, Phase
from services.jobs.portion import Portion

JOB = [e.name for e in CATALOGUE if e.phase != Phase.EVALUATION and e.when in ("", "photographs")] + [RENDER]


def passed_through(portion: Portion, names) -> list[float]:
    told = []
    for name in names:
        told.append(portion.at(name, 0.5))
        portion.passed(name)
    return told


def test_portion__of_a_usual_job_goes_by_shares_to_the_end():
    portion = Portion(1, textured=True)
    told = passed_through(portion, JOB)
    total = sum(SHARES[name] for name in JOB)
    assert told[0] == pytest.approx(SHARES[JOB[0]] / 2 / total)
    assert told[-1] == pytest.approx(1 - SHARES[RENDER] / 2 / total)


def test_portion__of_a_tradeoff_is_shared_by_its_points():
    portion = Portion(3, textured=True)
    ends = []
    for i in range(8):
        portion.round(i, 8)
        ends.append(passed_through(portion, JOB[:-1])[-1])
    assert ends == sorted(ends) and ends[1] < 0.26 and 0.8 < ends[-1] < 1


def test_portion__passes_of_learning_that_were_not_called_for_are_done():
    once, all_four = Portion(4, textured=True), Portion(4, textured=True)
    for _ in range(4):
        all_four.passed("ksvd-update")
    once.passed("ksvd-update")
    for portion in (once, all_four):
        portion.passed("quantise")
    assert once.at("encode", 0.5) == pytest.approx(all_four.at("encode", 0.5))


@given(st.lists(st.sampled_from([*SHARES, "of-tomorrow"]), max_size=60), st.booleans(), st.integers(1, 9))
def test_portion__never_goes_back_and_never_ends_early(names, textured, n_rounds):
    portion = Portion(4, textured)
    told = []
    for i in range(n_rounds):
        portion.round(i, n_rounds)
        told += passed_through(portion, names)
    assert told == sorted(told) and all(0 <= p < 1 for p in told)
