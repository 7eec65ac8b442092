"""Registers the codecs."""

from acwm_core.plugins import Registry, hookimpl

_NEEDS = {"extra": "codecs", "requires": ("diffusers", "huggingface_hub")}


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add the command that trains the codecs whose weights ship."""
    registry.add(
        "train-codec",
        "acwm_codecs.commands:train_codec",
        summary="train a codec, or its decoder, on your own data",
    )


@hookimpl
def register_codecs(registry: Registry) -> None:
    """Add codecs: four without downloads, those of published experiments, and any of diffusers."""
    registry.add(
        "compact",
        "acwm_codecs.compact:Compact",
        summary="small causal autoencoder with shipped weights: strides 8×8×4, 16 channels",
    )
    fine = "the same at half its stride, for small objects: strides 4×4×4, 16 channels"
    registry.add("fine", "acwm_codecs.compact:Fine", summary=fine)
    registry.add(
        "compact_reference",
        "acwm_codecs.compact_reference:CompactReference",
        summary="the latents of compact, decoded with the given frame: keeps what stands still",
    )
    registry.add(
        "compact_per_frame",
        "acwm_codecs.compact_per_frame:CompactPerFrame",
        summary="the same weights, applied to each frame alone: strides 8×8, 16 channels",
    )
    lossless = "lossless: folds blocks of pixels and frames into channels, nothing learned"
    registry.add("identity", "acwm_codecs.identity:Identity", summary=lossless)
    wan = "the video autoencoder of Wan 2.1: strides 8×8×4, 127 M parameters"
    for name, target, summary in (
        ("wan", "wan:Wan", wan),
        ("wan_per_frame", "wan:WanPerFrame", "the same with every frame by itself: strides 8×8"),
        ("flux", "flux:Flux", "the image autoencoder of FLUX.1, frame by frame: strides 8×8"),
    ):
        registry.add(name, f"acwm_codecs.{target}", summary=f"{summary}, 16 channels", **_NEEDS)
    for name, target, what in (
        ("autoencoder_kl", "KL", "AutoencoderKL, as of Stable Diffusion"),
        ("autoencoder_tiny", "Tiny", "AutoencoderTiny, as of TAESD"),
        ("autoencoder_dc", "DC", "AutoencoderDC, as of SANA"),
    ):
        registry.add(
            name,
            f"acwm_codecs.diffusers_image:{target}",
            summary=f"any {what}, frame by frame: codec.weights=FOLDER or a hub repository",
            **_NEEDS,
        )
