"""The ten lines in docs/rollout.md play with a model."""

import re
from pathlib import Path

import torch

from tests import tiny

PAGE = Path(__file__).parents[2] / "docs" / "rollout.md"


def test_the_lines_on_the_page_play(data, tmp_path):
    parts = {
        "codec": {"name": "identity"},
        "model": {"name": "dit_xs", "width": 16, "layers": 1},
        "conditioner": {"name": "adaln"},
        "objective": {"name": "diffusion_forcing", "prediction": "clean"},
    }
    run = tiny.make_run(tmp_path / "run", data, parts=parts)
    lines, more = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.M | re.S)
    assert lines.count('acwm.load("push_cube")') == 1
    names = {}
    exec(lines.replace("push_cube", str(run)), names)
    frames = names["frames"]
    assert frames.shape == (1, 4, 3, 32, 32)
    assert frames.isfinite().all()
    assert not torch.equal(frames[:, 0], names["first_frame"])
    names |= {"first_frames": torch.rand(1, 5, 3, 32, 32), "first_actions": torch.zeros(1, 4, 2)}
    exec(more, names)
    assert names["stream"].given.shape == (1, 5, 3, 32, 32)
    assert names["stream"].step(names["actions"]).shape == (1, 4, 3, 32, 32)
