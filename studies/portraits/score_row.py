"""All scores of one portrait's row: relit and turned pictures, and geometry and appearance of its avatar if there is
one."""

from pathlib import Path


def score_portrait(truth_folder: Path, row_folder: Path, exposures: dict[str, float]) -> dict[str, float]:
    """Scores of RUNS/ROW/NAME (`row_folder`) against BENCH/truth/NAME (`truth_folder`); `exposures` holds
    `relit_lights.exposure_of` by the name of the light, for all lights of the portrait's views.

    `VIEW_SCORE` of `relit_scores.score_view` for every VIEW.exr that is there: linear radiance [H, W, 3] under the
    environment as it is, at the pixels of the truth; its alpha, where it has one, is the coverage, else every pixel
    that is not black is covered. Where there is `avatar/avatar.json`, also the scores of
    `geometry_scores.score_geometry` and `appearance_scores.score_appearance`; where there is `head.npz` instead
    (`vertices`, `faces`, `landmarks`, `K`, `world_to_camera`: a head without an appearance), those of its geometry.
    What is absent has no scores. Raises InputError for files that are damaged or of another size than the photo."""
    raise NotImplementedError
