"""Foreground masks: person segmentation around the head, refined to the image's own edges, or a given mask file.

The network (`models/selfie_segmentation.tflite`) answers at 256x256, so its answers for nested square windows from
the head outwards are averaged. GrabCut (Rother, Kolmogorov and Blake 2004) then moves the outline to the image's
edges inside a narrow band, and a colour guided filter (He, Sun and Tang 2013) softens it to fractions of pixels.
Images here are sRGB-coded uint8 `[H, W, 3]`, masks float32 `[H, W]` in [0, 1].
"""

from pathlib import Path

import cv2
import numpy as np

from sira_mi.errors import InputError
from sira_mi.portrait.face import Face, load_network, sample_square
from sira_mi.portrait.load import Photo, load_stored, orient

_SIDE = 256  # pixels; the network's input and output
_WINDOWS = ((2.4, 0.0), (2.8, 0.1), (3.2, 0.25), (3.6, 0.4), (4.2, 0.6), (5.0, 0.95), (6.5, 1.5))  # side and centre
# below the face's centre, both in face sizes
_FRAME_WEIGHT = 0.01  # of the whole frame's answer, against the inverse squared side of a window in face sizes
_FEATHER = 0.08  # of a window's side: the outer band over which its weight falls to 0
_BAND = 0.07  # in face sizes: how far GrabCut may move the outline
_CUT_SIDE = 512  # pixels; longest side of the image that GrabCut works on
_CUT_ITERATIONS = 2
_EDGE_EPSILON = 4e-4  # variance of sRGB values in [0, 1] that counts as texture rather than edge
_COLOURED, _FEW = 0.1, 0.01  # difference of channels, and share of such pixels, that make a picture one in colour
_FACE_SHARE = 0.25  # of the face's landmarks that a given mask must contain
_CONTRAST = (0.1, 0.9)  # filtered values below and above these become 0 and 1


def segment_person(image: np.ndarray, face: Face) -> np.ndarray:
    """The person whose face this is, hair and clothes included, with soft edges."""
    probability = estimate_probability(image, face)
    outline = _cut_outline(image, clean_mask(probability, face), _BAND * face.size)
    radius = max(2, round(0.02 * face.size))
    refined = guided_filter(image.astype(np.float32) / 255, clean_mask(outline, face), radius, _EDGE_EPSILON)
    low, high = _CONTRAST
    return clean_mask(np.clip((refined - low) / (high - low), 0, 1), face)


def estimate_probability(image: np.ndarray, face: Face) -> np.ndarray:
    """Foreground probability `[H, W]`: the average over nested windows around the face and over mirror images, the
    closer windows weighing more."""
    height, width = image.shape[:2]
    left, top, right, bottom = face.box
    centre = np.array([(left + right) / 2, (top + bottom) / 2])
    frame = float(max(height, width))
    whole = np.full((height, width), _FRAME_WEIGHT, np.float32)
    windows: list[tuple[float, np.ndarray, np.ndarray]] = [(frame, np.array([width / 2, height / 2]), whole)]
    for side, below in _WINDOWS:
        middle, pixels = centre + np.array([0.0, below * face.size]), side * face.size
        weight = _window_weight(width, height, middle, pixels) / np.float32(side**2)
        windows.append((pixels, middle, weight))
    mirrored = np.ascontiguousarray(image[:, ::-1])
    total, total_weight = np.zeros((2, height, width), np.float32)
    for side, middle, weight in windows:
        answer = _run(image, middle, side) + _run(mirrored, np.array([width - middle[0], middle[1]]), side)[:, ::-1]
        total += weight * answer / 2
        total_weight += weight
    return total / total_weight


def clean_mask(mask: np.ndarray, face: Face | None) -> np.ndarray:
    """Keeps the part connected with the face (the largest part without a face) and fills enclosed holes."""
    solid = (mask > 0.5).astype(np.uint8)
    count, labels = cv2.connectedComponents(solid, connectivity=4)
    rows, columns = slice(None), slice(None)
    if face is not None:
        left, top, right, bottom = (max(0, round(v)) for v in face.box)
        rows, columns = slice(top, bottom + 1), slice(left, right + 1)
    areas = np.bincount(labels[rows, columns].ravel(), minlength=count)
    areas[0] = 0
    if not areas.any():
        return np.zeros_like(mask)
    kept = labels == areas.argmax()
    filled = _fill_holes(kept)
    others = (solid > 0) & ~filled
    around_others = _dilate(others) & ~_dilate(filled)
    result = np.where(others | around_others, 0, mask)
    return np.where(filled & ~kept, 1, result).astype(np.float32)


def guided_filter(guide: np.ndarray, values: np.ndarray, radius: int, epsilon: float) -> np.ndarray:
    """The colour guided filter, eqs 19-20 of He et al.: `values` `[H, W]` as a locally affine function of the guide
    `[H, W, 3]` in windows of `2 radius + 1` pixels."""

    def mean(x: np.ndarray) -> np.ndarray:
        return cv2.blur(x, (2 * radius + 1, 2 * radius + 1), borderType=cv2.BORDER_REFLECT)

    guide, values = guide.astype(np.float64), values.astype(np.float64)
    guide_mean, values_mean = mean(guide), mean(values)
    products = mean(np.stack([guide[..., i] * guide[..., j] for i, j in ((0, 0), (0, 1), (0, 2))], -1))
    more = mean(np.stack([guide[..., i] * guide[..., j] for i, j in ((1, 1), (1, 2), (2, 2))], -1))
    covariance = np.empty((*values.shape, 3, 3))
    for (i, j), second in zip(
        ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)), np.moveaxis(np.dstack([products, more]), -1, 0), strict=True
    ):
        covariance[..., i, j] = covariance[..., j, i] = second - guide_mean[..., i] * guide_mean[..., j]
    covariance += epsilon * np.eye(3)
    cross = mean(guide * values[..., None]) - guide_mean * values_mean[..., None]
    slope = np.linalg.solve(covariance, cross[..., None])[..., 0]
    offset = values_mean - (slope * guide_mean).sum(-1)
    return ((mean(slope) * guide).sum(-1) + mean(offset)).astype(np.float32)


def load_mask(path: str | Path, photo: Photo, max_pixels: int) -> np.ndarray:
    """A user's mask for that photo, `[H, W]` like `photo.image`; above 0.5 is foreground, soft edges are kept.

    It is white on black, or a cut-out, of which the alpha counts. Its size must be the photo's, either as stored in the
    file or as seen after EXIF orientation. Raises `InputError` for another size, an empty mask, a picture that is no
    mask, or a file that cannot be read.
    """
    stored = load_stored(path, max_pixels)
    mask, size = _read_grey(path, stored), stored.full_size
    if size != photo.full_size:
        if size != photo.stored_size:
            raise InputError(
                f"{path} is {size[0]}x{size[1]} pixels but the photo is {photo.full_size[0]}x{photo.full_size[1]}: "
                "give a mask of the photo's size"
            )
        mask = orient(mask, photo.orientation)
    if stored.reduction != photo.reduction or mask.shape != photo.image.shape[:2]:
        raise InputError(f"{path} does not cover the same pixels as the photo")
    if not (mask > 0.5).any():
        raise InputError(f"{path} is an empty mask: nothing in it is brighter than half (foreground is white)")
    return mask


def _read_grey(path: str | Path, stored: Photo) -> np.ndarray:
    """The alpha of a cut-out and of a picture of one colour, or else the brightness, times alpha, `[H, W]`."""
    colours, alpha = np.clip(stored.image, 0, 1), stored.alpha
    grey = colours.mean(axis=2)
    if alpha is not None and (is_cutout(alpha) or np.ptp(grey) == 0 < np.ptp(alpha)):
        return alpha
    if (np.ptp(colours, axis=2) > _COLOURED).mean() > _FEW:
        raise InputError(f"{path} is a picture in colour: a mask is white on the person and black elsewhere")
    if ((grey > 0.1) & (grey < 0.9)).sum() > 0.5 * (grey > 0.1).sum() and (grey > 0.5).any():
        raise InputError(f"{path} is mostly grey: a mask is white on the person and black elsewhere")
    return grey if alpha is None else grey * alpha


def check_mask(mask: np.ndarray, points: np.ndarray, mask_path: str | Path) -> None:
    """Raises `InputError` when a given mask `[H, W]` has hardly any of the face's `points` `[L, 2]` (pixels) in it.
    Points outside the image, and NaN, do not count."""
    height, width = mask.shape
    points = points[((points >= 0) & (points < (width, height))).all(axis=1)].astype(int)
    if not len(points):
        return
    share = float((mask[points[:, 1], points[:, 0]] > 0.5).mean())
    if share < _FACE_SHARE:
        raise InputError(
            f"{mask_path}: {share:.0%} of the face lies in the mask, which must be white on the person; is it inverted?"
        )


def is_cutout(alpha: np.ndarray) -> bool:
    """Whether a photo's alpha separates a figure from a background: neither opaque nor empty throughout."""
    foreground = float((alpha > 0.5).mean())
    return 0.01 < foreground < 0.99


def _cut_outline(image: np.ndarray, mask: np.ndarray, reach: float) -> np.ndarray:
    """Moves the outline of a mask by at most `reach` pixels, to where colours change; returns it at full resolution."""
    height, width = mask.shape
    scale = min(1.0, _CUT_SIDE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small_image = cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2BGR)
    inside = (cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 0.5).astype(np.uint8)
    diameter = 2 * max(2, round(reach * scale)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (diameter, diameter))
    labels = np.where(inside > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[cv2.erode(inside, disc) > 0] = cv2.GC_FGD
    labels[cv2.dilate(inside, disc) == 0] = cv2.GC_BGD
    if not {cv2.GC_FGD, cv2.GC_BGD} <= set(np.unique(labels)):
        return mask
    cv2.setRNGSeed(0)
    background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
    everything = (0, 0, *size)
    cv2.grabCut(small_image, labels, everything, background, foreground, _CUT_ITERATIONS, cv2.GC_INIT_WITH_MASK)
    cut = ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)).astype(np.float32)
    return cut if scale == 1 else np.clip(cv2.resize(cut, (width, height), interpolation=cv2.INTER_CUBIC), 0, 1)


def _run(image: np.ndarray, centre: np.ndarray, side: float) -> np.ndarray:
    """The network's answer for a square window, resampled to the image's pixels `[H, W]` (0 outside)."""
    network = load_network("selfie_segmentation")
    network.setInput(cv2.dnn.blobFromImage(sample_square(image, centre, side, 0.0, _SIDE), 1 / 255))
    answer = cv2.blur(network.forward("activation_10")[0, 0], (3, 3))
    scale = _SIDE / side
    shift = (np.full(2, 0.5) - centre) * scale + _SIDE / 2 - 0.5
    to_window = np.column_stack([np.eye(2) * scale, shift])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(answer, to_window, image.shape[1::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)


def _window_weight(width: int, height: int, centre: np.ndarray, side: float) -> np.ndarray:
    """1 inside a square window, 0 outside, with a smooth band within its border where the image goes on."""
    axes = []
    for length, middle in ((width, centre[0]), (height, centre[1])):
        distance = side / 2 - np.abs(np.arange(length) + 0.5 - middle)
        ramp = np.clip(distance / (_FEATHER * side), 0, 1)
        axes.append((ramp * ramp * (3 - 2 * ramp)).astype(np.float32))
    return axes[1][:, None] * axes[0][None, :]


def _fill_holes(solid: np.ndarray) -> np.ndarray:
    """Fills what is not connected with the outside of the image, bool `[H, W]`."""
    outside = cv2.copyMakeBorder((~solid).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    _, labels = cv2.connectedComponents(outside, connectivity=4)
    return labels[1:-1, 1:-1] != labels[0, 0]


def _dilate(region: np.ndarray) -> np.ndarray:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))
    return cv2.dilate(region.astype(np.uint8), disc) > 0
