"""The exported page: graphs beside PyTorch, what cannot be exported, and the page in a browser."""

import base64
import copy
import gzip
import io
import json
import tarfile

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.pictures import to_pixels
from acwm_core.env.camera import Camera
from acwm_core.errors import AcwmError, DataError, RecipeError
from acwm_core.model.batch import noise_of_clips
from acwm_core.model.objectives.regression import Regression
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog
from acwm_core.training.run import load_run
from acwm_play.export import episodes, graphs, page, runtime
from acwm_play.export.graphs import NEEDS_TORCH, OnnxStream, check, export_graphs
from acwm_play.layout import Pointing, physics_of
from acwm_play.simulator import SceneSpec, Simulator
from acwm_play.worlds import playable
from acwm_scene.declared import GroupSpec
from tests.browsing import DESK
from tests.extras import needs
from tests.play import follower

pytestmark = [pytest.mark.ci, needs("onnx")]


SIZE = (64, 64)

ABOVE = Camera((0.0, 0.0, 1.0), up=(0.0, 1.0, 0.0), fov=40.0)

OLD = pytest.mark.skipif(torch.__version__ < NEEDS_TORCH, reason=f"needs PyTorch {NEEDS_TORCH}")


def recurrent_world(given=1, codec="identity", name="recurrent", **parameters):
    """A small model with weights that make it follow actions and forget nothing."""
    codec = catalog().create("codec", codec)
    sizes = {"channels": 8, "width": 16, "blocks": 1, **parameters}
    model = catalog().create("model", name, latent_channels=codec.channels, **sizes)
    about = {"width": model.width, "layers": model.layers, "heads": model.heads}
    conditioner = catalog().create(
        "conditioner",
        "adaln",
        action_size=2,
        temporal_stride=codec.temporal_stride,
        **about,
    )
    bounds = [-1.0, -2.0], [1.0, 2.0]
    world = WorldModel(codec, model, conditioner, Regression(), *bounds, context_frames=given)
    follower.disturb(world)
    return world


@OLD
@pytest.mark.slow
def test_the_graphs_of_a_model_that_is_given_more_frames_are_its_stream():
    world = recurrent_world(given=5)
    made = export_graphs(world, SIZE)
    given = torch.rand(1, 5, 3, *SIZE)
    actions = torch.rand(1, 4 + 24, 2) * 2 - 1
    truth = world.stream(given, actions[:, :4])
    stream = OnnxStream(made, given[0].numpy())
    np.testing.assert_allclose(stream.given, truth.given[0, -1], atol=1e-5)
    seen = [truth.given[0, -1]]
    for start in range(4, 28, 4):
        rows = actions[:, start : start + 4]
        wanted = truth.step(rows)[0]
        np.testing.assert_allclose(stream.step(rows[0].numpy()), wanted, atol=1e-4)
        seen.append(wanted[-1])
    assert (seen[-1] - seen[1]).abs().max() > 0.01  # something moves


@OLD
@pytest.mark.slow
def test_the_graphs_of_a_model_that_draws_take_its_noise():
    world = recurrent_world(noise=6)
    made = export_graphs(world, SIZE)
    given = torch.rand(1, 3, *SIZE)
    actions = torch.rand(1, 4, 2) * 2 - 1
    seen = {}
    for seed in (1, 2):
        draw = noise_of_clips((6,), [torch.Generator().manual_seed(seed)]).numpy()
        stream = OnnxStream(made, given.numpy(), [draw])
        seen[seed] = stream.step(actions[0].numpy())
        truth = world.stream(given, seeds=[seed]).step(actions)[0]
        np.testing.assert_allclose(seen[seed], truth, atol=1e-4)
    assert np.abs(seen[1] - seen[2]).max() > 1e-3
    check(made, world, given.numpy(), actions[0].numpy())


@OLD
@pytest.mark.slow
def test_the_graphs_of_a_model_whose_codec_sees_the_given_frame_take_it():
    world = recurrent_world(codec="compact_reference")
    made = export_graphs(world, SIZE)
    given = torch.rand(1, 3, *SIZE)
    actions = torch.rand(8, 2) * 2 - 1
    check(made, world, given.numpy(), actions.numpy())
    other = OnnxStream(made, given.numpy())
    stream = OnnxStream(made, given.numpy())
    other._reference = np.zeros_like(other._reference)
    rows = actions[:4].numpy()
    assert np.abs(stream.step(rows) - other.step(rows)).max() > 0.01


@OLD
@pytest.mark.slow
@pytest.mark.parametrize(
    ("spec", "noise"),
    [
        (GroupSpec("bodies", tuple(range(10)), agents=1, bodies=2, camera=ABOVE), 3),
        (GroupSpec("values", tuple(range(4)), 2), 0),
        (GroupSpec("nodes", tuple(range(20)), agents=1, nodes=(9,), camera=ABOVE), 0),
    ],
    ids=lambda spec: getattr(spec, "kind", None),
)
def test_the_graphs_of_a_scene_are_its_stream(spec, noise):
    scene = {"specs": {spec.kind: spec}, "state_size": len(spec.columns), "noise": noise}
    world = recurrent_world(name="scene", **scene)
    made = export_graphs(world, SIZE)
    check(made, world, torch.rand(1, 3, *SIZE).numpy(), (torch.rand(24, 2) * 2 - 1).numpy())


def test_models_that_cannot_be_exported_are_refused():
    follower.register()
    world = recurrent_world()
    world.model = follower.Follower(latent_channels=world.codec.channels)
    with pytest.raises(RecipeError, match="a Follower cannot be exported: choose"):
        export_graphs(world, SIZE)
    world = recurrent_world()
    world.codec.memoryless = False
    with pytest.raises(RecipeError, match="has a stateful decoder"):
        export_graphs(world, SIZE)


def test_an_old_pytorch_is_refused(monkeypatch):
    monkeypatch.setattr(graphs, "NEEDS_TORCH", "99.1")
    with pytest.raises(RecipeError, match=r"--export needs PyTorch 99\.1 or later, not "):
        export_graphs(recurrent_world(), SIZE)


def test_homographies_say_where_actions_point():
    pytest.importorskip("mujoco", reason="needs the extra rigid")
    simulator = Simulator("push_cube", SIZE)
    pointing = Pointing.fit(simulator, physics_of("push_cube"))
    action = simulator.card.action
    ((there, back),) = episodes.maps(pointing, action.low, action.high)
    simulator.close()
    for place in np.random.default_rng(0).uniform(0.15, 0.85, (20, 2)):
        across = np.array(there) @ [*place, 1]
        np.testing.assert_allclose(across[:2] / across[2], pointing.action(place[None]), atol=1e-5)
        again = np.array(back) @ across
        np.testing.assert_allclose(again[:2] / again[2], place, atol=1e-9)


# ONNX Runtime for browsers ------------------------------------------------------------------------


def npm(folder, script):
    """A program in place of npm."""
    folder.mkdir()
    (folder / "npm").write_text(f"#!/bin/sh\n{script}\n")
    (folder / "npm").chmod(0o755)
    return str(folder)


@pytest.fixture
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("ACWM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_npm_fetches_the_runtime_once(cache, monkeypatch, tmp_path):
    packed = tmp_path / "onnxruntime-web.tgz"
    with tarfile.open(packed, "w:gz") as archive:
        for name in [*runtime.FILES.values(), "ort.all.min.js"]:
            entry = tarfile.TarInfo(f"package/dist/{name}")
            entry.size = len(name)
            archive.addfile(entry, io.BytesIO(name.encode()))
    wanted = {key: name.encode() for key, name in runtime.FILES.items()}
    monkeypatch.setenv("PATH", npm(tmp_path / "bin", f'/bin/cp {packed} "$5"'))
    assert runtime.runtime() == wanted
    monkeypatch.setenv("PATH", npm(tmp_path / "other", "exit 1"))
    assert runtime.runtime() == wanted  # from the cache


def test_what_keeps_the_runtime_away_is_told(cache, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", npm(tmp_path / "bin", "echo E404 not found >&2; exit 1"))
    with pytest.raises(DataError, match=r"npm could not fetch onnxruntime-web .*: E404 not found"):
        runtime.runtime()
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RecipeError, match="npm is needed once"):
        runtime.runtime()
    with pytest.raises(RecipeError, match="is not a folder of onnxruntime-web"):
        runtime.runtime(tmp_path)


def test_the_command_names_one_run_and_a_new_folder(run, tmp_path):
    said = CliRunner().invoke(main, ["play", "--export", str(tmp_path / "new")])
    assert (said.exit_code, "name one" in said.output) == (2, True)
    (tmp_path / "file").touch()
    said = CliRunner().invoke(main, ["play", str(run), "--export", str(tmp_path)])
    assert (said.exit_code, "is not empty" in said.output) == (2, True)


# The page -----------------------------------------------------------------------------------------


def has_runtime():
    try:
        return bool(runtime.runtime())
    except AcwmError:
        return False


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The page of a small model: its folder and the model."""
    pytest.importorskip("mujoco", reason="needs the extra rigid")
    return write_page(tmp_path_factory.mktemp("export"))


def write_page(folder, objective=None, **parameters):
    model = {"name": "recurrent", "channels": 8, "width": 16, "blocks": 1, **parameters}
    run = follower.make_run(folder / "run", model=model, conditioner="adaln", objective=objective)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "EPISODE_COUNT", 2)
        patch.setattr(episodes, "EPISODE_SECONDS", 1.6)
        if not has_runtime():
            patch.setattr(page, "runtime", lambda _: dict.fromkeys(runtime.FILES, b""))
        world = playable([run])[0]
        page.export(world, folder / "page")
    return folder / "page", load_run(world.run).world_model


LOGGED = """() => {
  window.log = [];
  for (const name of ["start", "step"]) {
    const work = socket.engine[name].bind(socket.engine);
    socket.engine[name] = async (...given) => {
      const seen = await work(...given);
      log.push([name, Array.from(given[0]), Array.from(seen)]);
      return seen;
    };
  }
}"""
"""Notes what the page gives the model, and gets."""


@OLD
def test_its_graphs_are_the_models_stream(written):
    folder, world = written
    made = {name: unpacked(folder, name) for name in ("start", "step", "decode")}
    rng = np.random.default_rng(0)
    frame, actions = rng.random((1, 3, *SIZE), np.float32), rng.random((24, 2), np.float32)
    assert check(made, world, frame, actions) < 1e-4
    frames = [OnnxStream(made, frame).step(sign * actions[:4])[-1] for sign in (1, -1)]
    assert np.abs(frames[0] - frames[1]).max() > 0.01  # it heeds actions
    other = copy.deepcopy(world)
    follower.disturb(other)
    with pytest.raises(RecipeError, match="the exported model differs from the original by"):
        check(made, other, frame, actions)


@OLD
def test_the_page_plays_from_a_disk_as_pytorch_does(browser, written):
    if not has_runtime():
        pytest.skip("needs npm, or ONNX Runtime Web in the cache")
    folder, world = written
    opened, complaints = browser.new_page(viewport=DESK), []
    opened.on("pageerror", lambda error: complaints.append(str(error)))
    opened.on("console", lambda s: complaints.append(s.text) if s.type == "error" else None)
    opened.goto((folder / "index.html").as_uri())
    opened.wait_for_function("Number(document.body.dataset.alone) > 0", timeout=300_000)
    opened.evaluate(LOGGED)
    opened.keyboard.press("b")  # the same recording again
    opened.wait_for_function("log.filter(([name]) => name === 'step').length > 3", timeout=300_000)
    assert not opened.locator(".sim .veil").is_visible()
    opened.keyboard.down("ArrowRight")
    opened.wait_for_function("actual()[0] === 1 || places[0][0] > 0.8", timeout=300_000)
    opened.wait_for_function("document.body.classList.contains('uncompared')", timeout=300_000)
    opened.evaluate("window.before = log.length")
    opened.wait_for_function("log.length > before + 3", timeout=300_000)
    opened.keyboard.up("ArrowRight")
    assert opened.locator(".sim .veil").is_visible()
    assert opened.inner_text("[data-name=pixel_error] dd") == "–"
    log = opened.evaluate("log")
    opened.close()
    assert complaints == []
    worst, rights = replayed(log, world)
    assert worst <= 1  # of 255: rounding
    assert max(rights[-3:]) > 0.7


@OLD
@pytest.mark.slow
def test_another_draw_in_the_page_is_another_future(browser, tmp_path):
    if not has_runtime():
        pytest.skip("needs npm, or ONNX Runtime Web in the cache")
    folder, _ = write_page(tmp_path, objective="energy_score", noise=6)
    opened = browser.new_page(viewport=DESK)
    opened.goto((folder / "index.html").as_uri())
    opened.wait_for_function("Number(document.body.dataset.alone) > 0", timeout=300_000)
    opened.evaluate("""() => {
      window.draws = [];
      const work = socket.engine.start.bind(socket.engine);
      socket.engine.start = (frames, dims, draw) => {
        draws.push(Array.from(draw));
        return work(frames, dims, draw);
      };
    }""")
    for key, number in (("z", 1), ("x", 2), ("z", 3)):  # another draw, the same one, another one
        opened.keyboard.press(key)
        opened.wait_for_function(f"draws.length >= {number}", timeout=300_000)
    assert opened.locator("#redraw").is_visible()
    first, same, other = opened.evaluate("draws")[:3]
    opened.close()
    assert len(first) == 6
    assert first == same != other


def replayed(log, world):
    """PyTorch's answers to the same: the worst difference, and the first dimension of actions."""
    stream, worst, rights = None, 0, []
    for name, given, seen in log:
        if name == "start":
            frames = torch.tensor(given, dtype=torch.float32).view(1, -1, *SIZE, 3) / 255
            stream = world.stream(frames.permute(0, 1, 4, 2, 3))
            wanted = stream.given[0, -1:]
        elif stream is None:
            continue
        else:
            wanted = stream.step(torch.tensor([given]))[0]
            rights.append(given[-1][0])
        found = np.array(seen, np.uint8).reshape(-1, *SIZE, 3)
        worst = max(worst, np.abs(found.astype(int) - to_pixels(wanted)).max())
    return worst, rights


@OLD
def test_the_episodes_are_the_simulators(written):
    folder, _ = written
    about = unpacked(folder, "about")
    simulator = Simulator("push_cube", SIZE)
    for episode in json.loads(about)["episodes"]:
        time_steps = simulator.start(SceneSpec(episode["index"]))
        time_steps += [simulator.step(np.array(row)) for row in episode["actions"]]
        frames = np.frombuffer(unpacked(folder, f"episode{episode['index']}"), np.uint8)
        truth = np.stack([time_step.frame for time_step in time_steps])
        np.testing.assert_array_equal(frames.reshape(truth.shape), truth)
    simulator.close()


def unpacked(folder, name):
    """A part of the page's data."""
    text = (folder / "data" / f"{name}.js").read_text()
    return gzip.decompress(base64.b64decode(text.split('"')[-2]))
