"""A sample of the corpus of harm: every mutant ends soon, in one line, and leaves nothing behind."""

import importlib.util
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[3]


def corpus():
    spec = importlib.util.spec_from_file_location("harm", ROOT / "benchmarks" / "harm.py")
    module = importlib.util.module_from_spec(spec)
    import sys

    sys.modules["harm"] = module
    spec.loader.exec_module(module)
    return module


def test_harm__500_mutants_end_well():
    harm = corpus()
    outcomes = harm.run(500, seed=11, n_workers=2)
    assert len(outcomes) == 500 and {o.code for o in outcomes} >= {0, 3}
    assert [(o.name, o.wrong, o.said[-300:]) for o in outcomes if o.wrong] == []


def test_harm__mutants_are_the_same_for_the_same_seed_and_differ_from_what_they_are_made_of():
    harm = corpus()
    content = bytes(range(256)) * 4
    made = [harm.mutated(content, np.random.default_rng([5, i])) for i in range(200)]
    assert made == [harm.mutated(content, np.random.default_rng([5, i])) for i in range(200)]
    assert sum(m != content for m in made) > 190 and len({len(m) for m in made}) > 20
