"""Every variant of the learning study is a recipe."""

from pathlib import Path

import pytest

from acwm_core.recipe import compose

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.ci
def test_variants_compose_and_differ(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    learning = pytest.importorskip("learning")
    study = learning.Study(tmp_path, 1.0, "2,2,2")
    for recipe in learning.RECIPES:
        made = {}
        for variant in learning.VARIANTS:
            name, *words = study.words(recipe, variant)
            made[variant] = compose(name, words).to_yaml()
        assert len(set(made.values())) == len(made)
        assert len({learning.slug(recipe, variant) for variant in made}) == len(made)


def test_every_curve_is_one_of_a_variant(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    curves = pytest.importorskip("learning_curves")
    assert curves.SHOWN.keys() <= pytest.importorskip("learning").VARIANTS.keys()
