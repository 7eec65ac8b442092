"""Every check of the suites that have no tests of flaws of their own can fail."""

import pytest

from tests.checks import (
    test_codecs,
    test_conditioners,
    test_estimators,
    test_importers,
    test_learners,
    test_metrics,
    test_models,
    test_objectives,
    test_planners,
)
from tests.checks.results import failures, in_words, only_run

MODULES = (
    test_codecs,
    test_conditioners,
    test_estimators,
    test_importers,
    test_learners,
    test_metrics,
    test_models,
    test_objectives,
    test_planners,
)
SUITES = [
    *(module.FLAWS for module in MODULES),
    test_metrics.SET_FLAWS,
    test_metrics.DRAWS_FLAWS,
]


@pytest.mark.parametrize(
    ("flaws", "flawed"),
    [pytest.param(flaws, flawed, id=flawed.__name__) for flaws in SUITES for flawed in flaws],
)
@pytest.mark.filterwarnings("ignore:divide by zero|invalid value")
def test_flaws_are_found(flaws, flawed, monkeypatch):
    check, reason = flaws[flawed]
    only_run(check, monkeypatch)
    assert reason in failures(flaws.suite(flawed, *flaws.arguments))[check]


@pytest.mark.parametrize("flaws", SUITES)
def test_every_check_has_a_flaw_that_it_finds(flaws):
    assert flaws.checks() == {in_words(check) for check in flaws.all}
