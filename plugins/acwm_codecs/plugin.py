"""Registers the codecs."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_codecs(registry: Registry) -> None:
    """The codecs that need nothing downloaded."""
    registry.add(
        "compact",
        "acwm_codecs.compact:Compact",
        summary="small causal autoencoder with shipped weights: strides 8×8×4, 16 channels",
    )
    registry.add(
        "identity",
        "acwm_codecs.identity:Identity",
        summary="lossless: folds blocks of pixels and frames into channels, nothing learned",
    )
