"""A benchmark that somebody else brings: a protocol and a table, evaluated with by name."""

import re
from types import MappingProxyType

import pytest
from click.testing import CliRunner

from acwm_core.cli.main import main
from acwm_core.errors import PluginError, RecipeError
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.protocol import (
    Protocol,
    PublishedRow,
    PublishedTable,
    protocol_named,
    published_for,
)
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.storage import read_scores
from acwm_core.plugins import Catalog, hookimpl
from tests import tiny


class Ends(Protocol):
    """The last frames of every second episode."""

    defaults = MappingProxyType({"frames": 5, "steps": 1})
    from_first_frame = False

    def episodes(self, count, wanted):
        return list(range(0, count, 2))

    def windows(self, length, frames, cuts):
        return [(length - frames, frames)]

    def tables(self):
        setting = {"env": "drift", "model": "big", "codec": "x", "conditioner": "y"}
        setting["fraction"] = 1.0
        scores = {"ind_test": {"mse": 0.25}, "ood_test": {"mse": 0.5}}
        row = PublishedRow("drifters", "tab:1", "Drift", "Foo 2031", "Big", "", setting, scores)
        return {"drifters": PublishedTable([row], "ends")}


class Benchmark:
    @staticmethod
    @hookimpl
    def register_protocols(registry):
        registry.add("ends", f"{__name__}:Ends")
        registry.add("broken", "builtins:list")


@pytest.fixture
def benchmark(monkeypatch):
    """A catalog with that plugin and no other protocol or table."""
    catalog = Catalog()
    catalog.add_plugin(Benchmark, "benchmark")
    monkeypatch.setattr("acwm_core.evaluation.protocol.catalog", lambda: catalog)


def test_a_foreign_protocol_and_table_are_evaluated_with(benchmark, data, tmp_path):
    run = tiny.make_run(tmp_path / "run", data, frames=None, videos=0, metrics=["psnr", "mse"])
    outcome = CliRunner().invoke(main, ["evaluate", str(run), "--protocol", "ends"])
    assert outcome.exit_code == 0, outcome.output
    assert {(r.episode, r.start, r.frames) for r in read_scores(run)} == {
        (episode, 8, 5) for episode in (0, 2, 4)
    }
    summary = Summary.read(run)
    assert summary.protocol == "ends"
    assert summary.provenance["sampling_steps"] == 1
    assert "perturbed" not in summary.left_out  # clips begin in the middle
    assert summary.published.row.row == "Big"
    printed = re.sub(r"\s+", " ", outcome.output)
    assert re.search(r"published: Big 250\.0+ 500\.0+▼", printed)
    assert "published: Foo 2031, tab:1 (big, x, y); this run has other components" in printed
    assert "--protocol ends" not in printed


def test_names_that_nothing_brings_are_refused_in_a_sentence(benchmark):
    with pytest.raises(RecipeError, match=r"protocol: unknown 'edns'; did you mean 'ends'\?"):
        EvaluationConfig(protocol="edns")
    with pytest.raises(RecipeError, match=r"unknown 'acwm-phys'; known: broken, ends, full\."):
        EvaluationConfig(protocol="acwm-phys")
    with pytest.raises(PluginError, match="returns a list, not a Protocol"):
        protocol_named("broken")


def test_a_broken_protocol_takes_no_table_with_it(benchmark):
    with pytest.warns(UserWarning, match="left out: protocol 'broken' returns a list"):
        found = published_for({"env": "drift"})
    assert found.row.row == "Big"


def test_no_row_is_of_another_environment():
    assert published_for({"env": "push_cub"}) is None
