"""What the doctor says of engines that work, are missing, or are broken."""

import threading
from pathlib import Path

import pytest
from click.testing import CliRunner

from acwm_core.cli import doctor, main
from acwm_core.plugins import Component, catalog


@pytest.mark.ci
def test_the_report_covers_this_installation(
    fresh_catalog: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of the engines really starts; the conformance tests start all in fresh processes."""
    tried: dict[str, str] = {}

    def trial(component: Component) -> doctor.Diagnosis:
        tried[component.requires or component.target.partition(":")[0]] = component.name
        started = component.name == "push_cube"
        return (
            original(component) if started else doctor.Diagnosis(component.name, True, "left out")
        )

    original = doctor.trial
    monkeypatch.setattr(doctor, "trial", trial)
    result = CliRunner().invoke(main, ["doctor"], prog_name="acwm")
    assert result.exit_code == 0, result.output
    for word in ("Python", "torch", "accelerator", *catalog().plugins, *tried.values()):
        assert word in result.output
    environments = catalog().registry("environment")
    assert set(tried) == {each.requires or each.target.partition(":")[0] for each in environments}
    assert "simulates and renders (mujoco" in result.output


def test_engines_are_started_side_by_side_and_once_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("acwm_core.executors.available_cores", lambda: 8)
    everyone, tried = threading.Barrier(8, timeout=600), list[str]()

    def trial(component: Component) -> doctor.Diagnosis:
        tried.append(component.name)
        if component.name.startswith("e"):
            everyone.wait()  # for ever, unless all are tried at once
        return doctor.Diagnosis(f"environment {component.name}", True, "simulates")

    def registry(kind: str) -> list[Component]:
        names = _names() * (kind == "environment")
        alone = [Component("environment", name, f"{name}:E", "p") for name in names]
        shared = ["a", "b", "c"] * (kind == "environment")
        return alone + [
            Component("environment", name, f"{name}:E", "p", requires=("torch",)) for name in shared
        ]

    monkeypatch.setattr(doctor, "trial", trial)
    monkeypatch.setattr(type(catalog()), "registry", lambda self, kind: registry(kind))
    found = [finding for finding in doctor.findings() if finding.what.startswith("environment")]
    assert [each.what for each in found] == [f"environment {n}" for n in [*_names(), "a"]]
    assert found[-1].note == "simulates; same simulator as b, c"
    assert sorted(tried) == ["a", *_names()]


def _names() -> list[str]:
    return [f"e{number}" for number in range(8)]


def test_an_engine_that_is_not_installed() -> None:
    component = Component(
        "environment", "e", "x:Y", "p", "dist", extra="sim", requires=("no_such_engine",)
    )
    assert doctor.trial(component) == doctor.Diagnosis(
        "environment e", None, "needs no_such_engine: pip install 'dist[sim]'"
    )


def test_an_engine_that_does_not_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library = "libX11.so.6: cannot open shared object file: No such file or directory"
    (tmp_path / "broken_engine.py").write_text(f"raise ImportError({library!r})\n")
    (tmp_path / "plugin_broken_engine.py").write_text(
        "from acwm_core.plugins import hookimpl\n\n"
        "@hookimpl\n"
        "def register_environments(registry):\n"
        "    registry.add('broken', 'broken_engine:Environment')\n"
    )
    info = tmp_path / "broken_engine-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken_engine\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[acwm]\nbroken_engine = plugin_broken_engine\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    component = Component("environment", "broken", "broken_engine:Environment", "broken_engine")
    what, works, note = doctor.trial(component)
    assert (what, works) == ("environment broken", False)
    assert note == (
        f"ImportError: {library}, in environment 'broken' of plugin 'broken_engine' "
        f"({tmp_path}/broken_engine.py:1); sudo apt-get install libx11-6"
    )


def test_exit_code_tells_that_something_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = [
        doctor.Diagnosis("engine", False, "broken"),
        doctor.Diagnosis("other", None, "absent"),
    ]
    monkeypatch.setattr(doctor, "findings", lambda: broken)
    result = CliRunner().invoke(main, ["doctor"])
    assert result.exit_code == 1
    assert "no engine" in " ".join(result.output.split())
    monkeypatch.setattr(doctor, "findings", lambda: broken[1:])
    assert CliRunner().invoke(main, ["doctor"]).exit_code == 0
