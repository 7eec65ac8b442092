"""A run of the recurrent model without training: it has a state that it carries on."""

from acwm_core.plugins import catalog
from tests import tiny


def make_run(folder, data):
    tiny.register()
    assert "recurrent" in catalog().registry("model")
    parts = {
        "env": {"name": "slide"},
        "codec": {"name": "identity"},
        "model": {"name": "recurrent", "channels": 8, "width": 8, "blocks": 1},
        "conditioner": {"name": "adaln"},
        "objective": {"name": "regression"},
        "data": {"path": str(data), "clip_frames": 13},
    }
    return tiny.make_run(folder, data, parts=parts)
