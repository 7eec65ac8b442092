"""The conformance suite for authors of components: named checks that pass or fail with a reason.

In a test of your own, with the registered name or the class itself::

    from acwm_core.checks import check_environment

    def test_conforms():
        assert [str(result) for result in check_environment("my_task") if not result.passed] == []

On the command line: ``acwm check my_task``.
"""

from acwm_core.checks.codec import check_codec
from acwm_core.checks.conditioner import check_conditioner
from acwm_core.checks.environment import check_environment
from acwm_core.checks.estimator import check_estimator
from acwm_core.checks.formats import check_dataset_exporter, check_dataset_importer
from acwm_core.checks.importer import check_importer
from acwm_core.checks.metric import check_metric
from acwm_core.checks.model import check_model
from acwm_core.checks.result import CheckResult

__all__ = [
    "CheckResult",
    "check_codec",
    "check_conditioner",
    "check_dataset_exporter",
    "check_dataset_importer",
    "check_environment",
    "check_estimator",
    "check_importer",
    "check_metric",
    "check_model",
]
