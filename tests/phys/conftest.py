from tests.evaluation.conftest import data, evaluated, parts

__all__ = ["data", "evaluated", "parts"]
