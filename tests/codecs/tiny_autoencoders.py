"""Tiny autoencoders with random weights, saved as the published ones are."""

import torch

from acwm_core.checks.trial import moving_discs


def _statistics(moments):
    """Mean and standard deviation per channel of latents `[B, C, …]`."""
    channels = moments.transpose(0, 1).flatten(1)
    return channels.mean(1), channels.std(1)


def _scene(frames):
    """`[1, 3, T, 48, 64]` in [-1, 1]."""
    return moving_discs(1, frames, 48, 64, 0).transpose(1, 2) * 2 - 1


@torch.no_grad()
def tiny_wan(**changes):
    """A narrow, shallow Wan 2.1 whose configuration has its own latent statistics."""
    from diffusers import AutoencoderKLWan

    torch.manual_seed(0)
    autoencoder = AutoencoderKLWan(**{"base_dim": 4, "num_res_blocks": 1, **changes}).eval()
    mean, deviation = _statistics(autoencoder.encode(_scene(9)).latent_dist.mode())
    autoencoder.register_to_config(latents_mean=mean.tolist(), latents_std=deviation.tolist())
    return autoencoder


@torch.no_grad()
def tiny_flux():
    """A narrow FLUX.1 autoencoder whose configuration has its own shift and scale."""
    from diffusers import AutoencoderKL

    torch.manual_seed(0)
    autoencoder = AutoencoderKL(
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        block_out_channels=(8, 8, 16, 16),
        norm_num_groups=4,
        latent_channels=16,
        use_quant_conv=False,
        use_post_quant_conv=False,
    ).eval()
    moments = autoencoder.encode(_scene(4)[0].transpose(0, 1)).latent_dist.mode()
    shift, scale = moments.mean().item(), 1 / moments.std().item()
    autoencoder.register_to_config(shift_factor=shift, scaling_factor=scale)
    return autoencoder


def save_tiny_codecs(folder):
    """Folders of tiny weights by the name of the codec that takes them."""
    tiny_wan().save_pretrained(folder / "wan")
    tiny_flux().save_pretrained(folder / "flux")
    return {
        "wan": str(folder / "wan"),
        "wan_per_frame": str(folder / "wan"),
        "flux": str(folder / "flux"),
    }


_WITHIN_A_BLOCK = (
    ("norm1", "residual.0"),
    ("conv1", "residual.2"),
    ("norm2", "residual.3"),
    ("conv2", "residual.6"),
    ("conv_shortcut", "shortcut"),
)


def original_state(autoencoder):
    """A Wan 2.1's weights under the names of the original release.

    There every half is one numbered sequence: conv1, residual blocks and resamplers, middle, head;
    the decoder has three residual blocks before each resampler.
    """
    places = {"quant_conv": "conv1", "post_quant_conv": "conv2"}
    for half in ("encoder", "decoder"):
        places |= {
            f"{half}.conv_in": f"{half}.conv1",
            f"{half}.norm_out": f"{half}.head.0",
            f"{half}.conv_out": f"{half}.head.2",
            f"{half}.mid_block.resnets.0": f"{half}.middle.0",
            f"{half}.mid_block.attentions.0": f"{half}.middle.1",
            f"{half}.mid_block.resnets.1": f"{half}.middle.2",
        }
    places |= {f"encoder.down_blocks.{i}": f"encoder.downsamples.{i}" for i in range(11)}
    for stage in range(4):
        places[f"decoder.up_blocks.{stage}.upsamplers.0"] = f"decoder.upsamples.{4 * stage + 3}"
        for block in range(3):
            ours = f"decoder.up_blocks.{stage}.resnets.{block}"
            places[ours] = f"decoder.upsamples.{4 * stage + block}"
    return {_renamed(name, places): tensor for name, tensor in autoencoder.state_dict().items()}


def _renamed(name, places):
    place = next(place for place in places if name.startswith(f"{place}."))
    rest = name.removeprefix(f"{place}.")
    for ours, theirs in _WITHIN_A_BLOCK:
        if rest.startswith(f"{ours}."):
            rest = theirs + rest.removeprefix(ours)
    return f"{places[place]}.{rest}"
