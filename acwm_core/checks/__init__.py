"""The conformance suite for authors of components: named checks that pass or fail with a reason.

Use it in your own tests, with the registered name or the class itself, and constructor parameters::

    from acwm_core.checks import check_environment

    def test_conforms():
        assert [str(result) for result in check_environment("my_task") if not result.passed] == []

On the command line: ``acwm check my_task``.
"""

from acwm_core.checks.codec import CodecChecks
from acwm_core.checks.conditioner import ConditionerChecks
from acwm_core.checks.environment import EnvironmentChecks
from acwm_core.checks.estimator import EstimatorChecks
from acwm_core.checks.metric import MetricChecks
from acwm_core.checks.model import check_model
from acwm_core.checks.objective import ObjectiveChecks
from acwm_core.checks.result import CheckResult
from acwm_core.checks.task import check_task

check_codec = CodecChecks.check
check_conditioner = ConditionerChecks.check
check_environment = EnvironmentChecks.check
check_estimator = EstimatorChecks.check
check_metric = MetricChecks.check
check_objective = ObjectiveChecks.check

__all__ = [
    "CheckResult",
    "check_codec",
    "check_conditioner",
    "check_environment",
    "check_estimator",
    "check_metric",
    "check_model",
    "check_objective",
    "check_task",
]
