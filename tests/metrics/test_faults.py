"""Faults that are put into the simulators are found in what the estimators read."""

from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def checked(monkeypatch):
    pytest.importorskip("mujoco")
    pytest.importorskip("taichi")
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from violations import TRUE, checked

    return lambda *words: [(name == TRUE, name, seen) for name, seen in checked(*words)]


@pytest.mark.ci
def test_cubes_that_are_deleted_added_doubled_split_or_merged_are_found(checked):
    found = checked("push_cube", 2, 64, 15)
    assert len({name for _, name, _ in found}) == 6
    for lawful, name, seen in found:
        assert bool(seen) != lawful, name
        if not lawful:
            assert ("permanence" in seen) == ("within" not in name), name


@pytest.mark.parametrize(
    ("world", "frames", "violation"),
    [
        pytest.param("stack_cube", 0, "permanence", marks=pytest.mark.ci),
        ("push_rope", 0, "length of the rope"),
        pytest.param("pour_water", 90, "amount of water", marks=pytest.mark.ci),
    ],
)
@pytest.mark.ci
def test_faults_break_the_law_that_they_should_and_true_videos_none(
    checked, world, frames, violation
):
    found = checked(world, 2, 64, frames)
    assert [lawful for lawful, *_ in found] == [True, False] * 2
    for lawful, name, seen in found:
        assert seen == ([] if lawful else [violation]), name


@pytest.mark.slow
@pytest.mark.parametrize("world", ["reacher", "cloth_move", "robot_arm"])
def test_faults_of_other_worlds_are_found(checked, world):
    found = checked(world, 2, 64, 0)
    assert [seen for lawful, _, seen in found if lawful] == [[], []]
    assert all(seen for lawful, _, seen in found if not lawful), found
