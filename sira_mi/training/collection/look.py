"""Appearance drawn at random for each person: skin tone, hair, eyes and clothes, by age, sex and ancestry."""

from dataclasses import dataclass

import numpy as np

# Mean melanin of `makehuman.ANCESTRIES`.
MELANIN = np.array([0.7, 0.2, 0.08])

HAIR_COLOURS = {
    "black": (0.012, 0.010, 0.009),
    "dark brown": (0.045, 0.026, 0.016),
    "brown": (0.12, 0.068, 0.036),
    "light brown": (0.22, 0.135, 0.072),
    "blond": (0.46, 0.32, 0.16),
    "red": (0.30, 0.085, 0.025),
    "grey": (0.36, 0.35, 0.34),
    "white": (0.62, 0.61, 0.58),
}
IRIS_COLOURS = {
    "brown": (0.055, 0.025, 0.012),
    "dark brown": (0.025, 0.012, 0.008),
    "hazel": (0.12, 0.075, 0.025),
    "green": (0.11, 0.14, 0.06),
    "blue": (0.10, 0.18, 0.30),
    "grey": (0.19, 0.21, 0.22),
}


@dataclass(frozen=True)
class Traits:
    """The traits that a look depends on."""

    years: float  # age, years
    male: float  # 0 female to 1 male
    ancestry: tuple[float, ...]  # shares of `makehuman.ANCESTRIES`, sum 1


@dataclass(frozen=True)
class Look:
    """The appearance of one person; colours are linear."""

    melanin: float  # 0 light to 1 dark
    haemoglobin: float  # standard deviations
    redness: float  # strength on cheeks, nose and ears
    hair_name: str  # key of `HAIR_COLOURS`
    hair_colour: tuple[float, ...]
    iris_name: str  # key of `IRIS_COLOURS`
    iris_colour: tuple[float, ...]
    gaze: tuple[float, float]  # radians, yaw and pitch
    brow_strength: float  # 0 to 1
    brow_width: float  # factor on the brows' height
    stubble: float  # 0 none to 1 a dense short beard, painted
    freckles: float  # 0 none to 1
    lipstick: tuple[float, ...] | None
    scalp: float  # strength of painted hair on the scalp, 0 bald to 1
    specular: float  # base specular strength of the skin
    cloth_colour: tuple[float, ...]
    shirt_colour: tuple[float, ...] | None  # a second cloth down the middle, as under a jacket
    collar: float  # decimetres that the neck line is moved up
    neck_opening: float  # decimetres that a V-neck is deep
    cloth_thickness: float  # scene units
    seed: int  # of the fine noise


def sample_look(random: np.random.Generator, traits: Traits, has_hair: bool) -> Look:
    """Draws colours and details by age, sex and ancestry."""
    share = np.array(traits.ancestry)
    melanin = float(np.clip(share @ MELANIN + random.normal(0, 0.1), 0, 1))
    hair_name = _hair_name(random, traits)
    spread = np.exp(random.normal(0, 0.18) + random.normal(0, 0.05, 3))
    light_eyes = share[2] * 0.75
    iris_name = str(random.choice(["blue", "green", "hazel", "grey"])) if random.random() < light_eyes else "brown"
    if iris_name == "brown" and random.random() < share[0] + share[1]:
        iris_name = "dark brown"
    male = traits.male > 0.5
    lipstick = None
    if not male and random.random() < 0.3:
        lipstick = tuple(float(c) for c in np.array([0.42, 0.05, 0.07]) * np.exp(random.normal(0, [0.3, 0.4, 0.3])))
    return Look(
        melanin=melanin,
        haemoglobin=float(random.normal(0.3, 0.6)),
        redness=float(random.uniform(0.3, 1.2)),
        hair_name=hair_name,
        hair_colour=tuple(float(c) for c in np.array(HAIR_COLOURS[hair_name]) * spread),
        iris_name=iris_name,
        iris_colour=tuple(float(c) for c in np.array(IRIS_COLOURS[iris_name]) * np.exp(random.normal(0, 0.25))),
        gaze=(float(random.normal(0, 0.10)), float(random.normal(0, 0.05))),
        brow_strength=float(random.uniform(0.5, 0.95)),
        brow_width=float(random.uniform(0.75, 1.25) * (1.15 if male else 0.9)),
        stubble=float(random.beta(0.9, 1.3)) if male and random.random() < 0.6 else 0.0,
        freckles=float(random.uniform(0.3, 1)) if melanin < 0.35 and random.random() < 0.25 else 0.0,
        lipstick=lipstick,
        scalp=0.0 if has_hair or random.random() < 0.35 else float(random.uniform(0.35, 0.95)),
        specular=float(np.clip(random.normal(0.375, 0.09), 0.15, 0.65)),
        cloth_colour=_cloth_colour(random),
        shirt_colour=_cloth_colour(random) if random.random() < 0.3 else None,
        collar=float(random.choice([random.normal(0, 0.06), random.uniform(0.1, 0.3)], p=[0.8, 0.2])),
        neck_opening=float(random.choice([random.uniform(0, 0.12), random.uniform(0.15, 0.5)], p=[0.6, 0.4])),
        cloth_thickness=float(random.uniform(0.03, 0.16)),
        seed=int(random.integers(2**31)),
    )


def _hair_name(random, traits):
    grey = np.clip((traits.years - 42) / 35, 0, 1)
    if random.random() < grey:
        return str(random.choice(["grey", "white"], p=[0.7, 0.3] if traits.years < 70 else [0.4, 0.6]))
    if random.random() < traits.ancestry[0] + traits.ancestry[1]:
        return str(random.choice(["black", "dark brown", "brown"], p=[0.6, 0.3, 0.1]))
    names = ["black", "dark brown", "brown", "light brown", "blond", "red"]
    return str(random.choice(names, p=[0.08, 0.24, 0.26, 0.16, 0.18, 0.08]))


def _cloth_colour(random):
    kind = random.random()
    if kind < 0.2:
        colour = np.full(3, random.uniform(0.5, 0.82)) * np.exp(random.normal(0, 0.03, 3))
    elif kind < 0.45:
        colour = np.exp(random.uniform(-4.2, -2.6) + random.normal(0, 0.25, 3))
    else:
        hue = random.uniform(0, 6)
        pure = np.clip(np.abs((hue + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
        colour = (1 - random.uniform(0.2, 0.95) * (1 - pure)) * random.uniform(0.08, 0.65)
    return tuple(float(c) for c in np.clip(colour, 0.01, 0.85))
