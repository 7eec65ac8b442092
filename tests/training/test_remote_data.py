"""Training and evaluating on a dataset behind a URL gives what the local folder gives."""

import pytest

from acwm_core.data import remote
from acwm_core.training.fit import fit
from acwm_core.training.run_folder import RunFolder
from tests.data.serving import served
from tests.tiny import tiny_recipe
from tests.training.runs import assert_same


def test_a_run_on_a_url_is_the_run_on_the_folder(data, tmp_path, monkeypatch):
    """Every file is asked for once."""
    monkeypatch.setenv(remote.CACHE, str(tmp_path / "cache"))
    whole = RunFolder(fit(tiny_recipe(data), tmp_path / "local"))
    with served(data) as server:
        run = RunFolder(fit(tiny_recipe(server.url), tmp_path / "remote"))
    assert set(server.asked.values()) == {1}
    assert {"/card.yaml", "/train/manifest.jsonl"} <= set(server.asked)
    assert_same(whole, run)
    shards = {path.name for path in (tmp_path / "cache").rglob("*.tar")}
    assert shards == {path.name for path in data.glob("train/*.tar")}
    assert list((tmp_path / "cache").rglob("latents/*/*/*.npy"))


def test_a_run_may_stream_a_url(data, tmp_path, monkeypatch):
    monkeypatch.setenv(remote.CACHE, str(tmp_path / "cache"))
    streamed = {"data": {"reader": "webdataset"}}
    recipe = tiny_recipe(f"file://{data}", trainer={"max_steps": 8}, **streamed)
    with pytest.warns(UserWarning, match="cannot continue exactly") as caught:
        run = RunFolder(fit(recipe, tmp_path / "run"))
    assert len([each for each in caught if "cannot continue" in str(each.message)]) == 1
    assert run.weights.exists()
    assert "val/loss" in run.metrics.read_text()
    assert not list((tmp_path / "cache").rglob("latents"))
    with pytest.warns(UserWarning, match="cannot continue exactly"):
        fit(tiny_recipe(f"file://{data}", **streamed), run.path, resume="auto")
