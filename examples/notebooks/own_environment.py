# %% [markdown]
# # Your own environment

# %% [markdown]
# An environment is a card and six methods. This one is a puck on ice: a force moves it, and walls
# reflect it. Physics and drawing are written in numpy.
#
# For 3-D scenes there is a renderer; see the guide "3-D scenes". `acwm new environment NAME`
# creates a package to start from.

# %%
import numpy as np
from PIL import Image

from acwm_core.env.camera import Camera
from acwm_core.env.environment import ActionSpec, Environment, EnvironmentCard, StateField
from acwm_core.env.episode import EpisodeSpec, Factor

# %% [markdown]
# ## The card
#
# The card holds everything that a dataset and a model need to know: names, units and bounds of the
# actions, what varies, what the state holds, what the mask shows. A factor has one range for
# training and other ranges for the out-of-distribution test.

# %%
FORCE, RADIUS = 1.5, 0.12  # newtons; metres. The rink reaches from -1 to 1.

CARD = EnvironmentCard(
    name="puck",
    summary="A force moves a puck on ice between walls.",
    action=ActionSpec(("x", "y"), ("N", "N"), (-FORCE, -FORCE), (FORCE, FORCE), "torque"),
    frame_size=(64, 64),
    fps=10,
    horizon=48,
    factors=(
        Factor.continuous(
            *("mass", "of the puck"),
            **{"train": (0.3, 0.6), "ood": ((1.0, 1.5),), "nominal": 0.45},
            unit="kg",
            active=True,
        ),
    ),
    ood_shifts=("mass",),
    state=(
        StateField("position", (2,), "m", "x right, y up", "position", ("puck",)),
        StateField("velocity", (2,), "m/s", "rate of change of the position", "vector", ("puck",)),
    ),
    instances=("ice", "puck"),
    engine="numpy",
    camera=Camera.flat(1.0),  # from -1 to 1, and so where positions are in the picture
)

# %% [markdown]
# ## The methods
#
# All randomness comes from the generators that are passed in, so an episode has the same bytes
# everywhere. Edges are anti-aliased, because a model cannot learn sub-pixel motion from jagged
# edges.


# %%
class Puck(Environment):
    """Starts at rest at a random place; a wall halves the speed."""

    card = CARD

    def _start(self, factors, rng):
        self.mass = float(factors["mass"])
        self.position, self.velocity = rng.uniform(-0.6, 0.6, 2), np.zeros(2)
        self.hit = False

    def _advance(self, action):
        self.hit, dt = False, 0.01
        for _ in range(round(1 / self.card.fps / dt)):
            self.velocity += dt * (action.astype(float) / self.mass - 0.4 * self.velocity)
            self.position += dt * self.velocity
            beyond = np.abs(self.position) > 1 - RADIUS
            self.hit |= bool(beyond.any())
            self.velocity[beyond] *= -0.5
            self.position = self.position.clip(RADIUS - 1, 1 - RADIUS)

    def _render(self):
        height, width = self.frame_size
        pixel = 2 / height
        y, x = np.mgrid[:height, :width]
        across = (x - (width - 1) / 2) * pixel - self.position[0]
        along = ((height - 1) / 2 - y) * pixel - self.position[1]
        inside = RADIUS - np.hypot(across, along)
        share = (0.5 + inside / pixel).clip(0, 1)[..., None]
        ice, puck = np.array([225.0, 235.0, 240.0]), np.array([200.0, 40.0, 40.0])
        return (ice + share * (puck - ice)).round().astype(np.uint8), (inside > 0).astype(np.uint8)

    def _state(self):
        return {"position": self.position.copy(), "velocity": self.velocity.copy()}

    def _contacts(self):
        return ()  # the walls are not part of the mask

    def policy(self, rng):
        """Random forces, each held for 3 to 9 frames."""

        def forces():
            while True:
                force = rng.uniform(-FORCE, FORCE, 2)
                for _ in range(rng.integers(3, 10)):
                    yield force

        return forces().__next__


# %% [markdown]
# ## Try it

# %%
env = Puck()
spec = EpisodeSpec("puck", "ind_test", 0)
frame, info = env.reset(options={"spec": spec})
policy = env.policy(spec.rng("policy"))
frames = [frame] + [env.step(np.asarray(policy(), np.float32))[0] for _ in range(47)]
picture = Image.fromarray(np.concatenate(frames[::6], 1))
picture.save("puck.png")
picture

# %% [markdown]
# ## Register it and make a dataset
#
# A package registers its environment with an entry point. A notebook adds it to the catalog.

# %%
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.plugins import catalog, hookimpl


class Plugin:
    """What an entry point would point to."""

    @staticmethod
    @hookimpl
    def register_environments(registry):
        registry.add("puck", f"{__name__}:Puck", summary="a puck on ice")


catalog().add_plugin(Plugin(), "puck")
generate("puck", "puck_data", episodes={"train": 8, "ind_test": 2, "ood_test": 2}, workers=0)
episode = EpisodeDataset("puck_data", "ood_test")[0]
print("video", episode.video.shape, "actions", episode.actions.shape)
print("mass in this episode:", info["factors"]["mass"], "kg")

# %% [markdown]
# An episode is identical whenever it is simulated:

# %%
again, _ = Puck().reset(options={"spec": spec})
assert np.array_equal(again, frame)

# %% [markdown]
# Put the class into a package (`acwm new environment puck`), and use it on the command line:
#
# ```bash
# acwm check puck
# acwm generate puck --episodes 1000,64,64 --out data/puck
# acwm fit small data.path=data/puck
# ```
