"""The layers of a picture by `sira_sg`, and the channels of the film that hold them."""

import numpy as np

# The extra channels in order: each layer by the names of its channels, "" for a layer of one channel.
EXTRA_LAYERS = {
    "diffuse": "RGB",
    "specular": "RGB",
    "diffuse_albedo": "RGB",
    "specular_albedo": "",
    "normal": "XYZ",
    "depth": "",
    "mask": "",
}
# The film's own channels, which come first: radiance and alpha.
_FILM_CHANNELS = 4


def channel_count(layer: str) -> int:
    """Number of channels of one of `EXTRA_LAYERS`."""
    return max(len(EXTRA_LAYERS[layer]), 1)


def extra_channel_names() -> list[str]:
    """The extra channels as Mitsuba names them: `diffuse.R`, …, `mask`."""
    return [f"{layer}.{c}" if c else layer for layer, channels in EXTRA_LAYERS.items() for c in channels or [""]]


def split_layers(image: np.ndarray) -> dict[str, np.ndarray]:
    """All layers of a film [H, W, 19], `final` being the radiance: [H, W, 3], those of one channel [H, W]."""
    layers, start = {"final": image[..., :3]}, _FILM_CHANNELS
    for layer, channels in EXTRA_LAYERS.items():
        end = start + channel_count(layer)
        layers[layer] = image[..., start:end] if channels else image[..., start]
        start = end
    return layers
