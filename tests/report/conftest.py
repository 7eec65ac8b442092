"""The runs that tests of reports share: those of the tests of evaluation."""

from tests.evaluation.conftest import data, evaluated, parts

__all__ = ["data", "evaluated", "parts"]
