"""Every installed importer conforms, and every check of importers can fail."""

import dataclasses

import pytest
import torch

from acwm_core.checks.result import checks_of
from acwm_core.errors import DataError
from acwm_zoo.checks import ImporterChecks, check_importer
from acwm_zoo.published_dit import PublishedCheckpoint
from tests.checks.results import Flaws, failures, installed

FLAWS = Flaws(check_importer, checks_of(ImporterChecks))
NAMES = "names what is missing", "names what has another shape"


@pytest.mark.ci
@pytest.mark.parametrize("part", installed("importer"), ids=lambda part: part.name)
def test_installed_importers_conform(part):
    assert failures(check_importer(part.name)) == {}


@FLAWS.caught_by("reads its example", "not a ForeignModel")
class ReadsNothing(PublishedCheckpoint):
    def read(self, content):
        return None


@FLAWS.caught_by("reads its example", "not finite")
class Diverged(PublishedCheckpoint):
    def example(self):
        content, words = super().example()
        content["model_state_dict"]["model.x_proj.bias"][0] = torch.nan
        return content, words


@FLAWS.caught_by("leaves other content alone", "for its format")
class TakesAnything(PublishedCheckpoint):
    def read(self, content):
        return super().read(content) or super().read(self.example()[0])


class Changed(PublishedCheckpoint):
    """An importer whose conversion is changed."""

    def read(self, content):
        found = super().read(content)
        if found is None:
            return None

        def convert(model, conditioner):
            return self.converted(found, model, conditioner)

        return dataclasses.replace(found, convert=convert)


@FLAWS.caught_by("uses every weight", "final.linear.bias does not depend")
class LeavesOneAtZero(Changed):
    def converted(self, found, model, conditioner):
        state, other = found.convert(model, conditioner)
        state["final.linear.bias"] = torch.zeros_like(state["final.linear.bias"])
        return state, other


@FLAWS.caught_by("names what is missing", "no model.")
class SaysOnlyThatItIsDamaged(Changed):
    def read(self, content):
        try:
            return super().read(content)
        except DataError:
            raise DataError("the checkpoint is damaged") from None

    def converted(self, found, model, conditioner):
        try:
            return found.convert(model, conditioner)
        except DataError:
            raise DataError("the checkpoint is damaged") from None


@FLAWS.caught_by("names what has another shape", "has another shape of")
class DropsAxes(PublishedCheckpoint):
    def read(self, content):
        state = content.get("model_state_dict")
        if isinstance(state, dict):
            flat = {
                name: value[0] if value.ndim > 1 and len(value) == 1 else value
                for name, value in state.items()
            }
            content = {**content, "model_state_dict": flat}
        return super().read(content)
