"""The metric in docs/physics.md is one."""

import re
from pathlib import Path

from acwm_core.checks import check_metric

PAGE = Path(__file__).parents[2] / "docs" / "physics.md"


def test_the_example_conforms():
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    module = {}
    exec(code, module)
    results = list(check_metric(module["SpeedError"]))
    assert [str(result) for result in results if not result.passed] == []
    assert len(results) > 3


def test_every_metric_of_physics_is_on_the_page():
    from acwm_metrics.plugin import PHYSICS

    text = PAGE.read_text()
    assert [name for name in PHYSICS if f"`{name}`" not in text] == []
