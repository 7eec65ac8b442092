"""The pages of metrics: the example is a metric, and every metric of physics is explained."""

import re
from pathlib import Path

from acwm_core.checks import check_metric

DOCS = Path(__file__).parents[2] / "docs"


def test_the_example_conforms():
    page = (DOCS / "own-metric.md").read_text()
    found = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (code,) = [each for each in found if "class SpeedError" in each]
    module = {}
    exec(code, module)
    results = list(check_metric(module["SpeedError"]))
    assert [str(result) for result in results if not result.passed] == []
    assert len(results) > 3


def test_every_metric_of_physics_is_on_the_page():
    from acwm_metrics.plugin import PHYSICS

    text = (DOCS / "reference" / "metrics.md").read_text()
    assert [name for name in PHYSICS if f"`{name}`" not in text] == []
