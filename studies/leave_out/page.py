"""`docs/plan.md` from measured plans."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import sira_mi
from sira_mi.avatar.file import PRIOR, load_avatar, save_avatar
from sira_mi.decisions import Plan
from sira_mi.files import write_through
from sira_mi.fit.fit import FitRequest, read_portrait
from sira_mi.fit.measure import measure_fit
from sira_mi.fit.settings import QUALITIES
from sira_mi.fit.stage import FitTask
from sira_mi.fit.state import initial_state
from sira_mi.relight.leave_out import TOLERANCE, plan_relight
from sira_mi.relight.measure import measure_plan
from sira_mi.relight.render import RelightSettings, load_head
from sira_mi.relight.subject import Light, Subject, read_light, read_subject

# Lights that are a hundred-thousandth as bright as the brightest of the avatar.
_DIM = 1e-5


def _row(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"


def _number(value: float | None) -> str:
    return "–" if value is None else "0" if value == 0 else f"{value:.1e}"


def plan_table(plan: Plan) -> str:
    """A Markdown table of the decisions."""
    lines = [_row("decision", "about", "", "condition", "bound", "measured", "noise", "time saved"), _row(*["---"] * 8)]
    for d in plan.decisions:
        verdict = "left out" if d.left_out else "needed"
        saved = "–" if d.saved is None else f"{100 * d.saved:.0f} ± {100 * d.saved_spread:.0f} %"
        figures = [_number(d.bound), _number(d.error), _number(d.noise), saved] if d.left_out else ["–"] * 4
        lines.append(_row(d.name, d.where, verdict, d.reason, *figures))
    return "\n".join(lines)


def commands() -> list[str]:
    """Names of the project's commands, as `python -m sira_mi.NAME`."""
    folder = Path(sira_mi.__file__).parent
    return sorted(".".join(file.parent.relative_to(folder).parts) for file in folder.rglob("__main__.py"))


def relight_cases(subject: Subject, light: Light, matt: Subject) -> list[tuple[str, str, Subject, Light]]:
    """(title, integrator, subject, light) of the pictures on the page: the avatar as it is, and scenes that need less;
    `matt` is the avatar with k_s = 0."""
    lobes = subject.avatar.tensors["lobes"]
    dim = np.concatenate([lobes, lobes])
    dim[len(lobes) :, 4:] *= _DIM
    return [
        ("The light asked for, closed form", "sg", subject, light),
        ("The light asked for, path tracing", "path", subject, light),
        ("The photo's lobes and as many dim ones, closed form", "sg", subject, Light(dim)),
        ("Without speculars (k_s = 0), closed form", "sg", matt, light),
        ("Without speculars (k_s = 0), path tracing", "path", matt, light),
    ]


def _import_table() -> str:
    lines = [_row("command", "seconds", "modules", "of them heavy"), _row(*["---"] * 4)]
    statements = {"import sira_mi": "import sira_mi"}
    statements["import sira_mi, a variant set"] = (
        "import sira_mi, mitsuba; mitsuba.set_variant('llvm_ad_rgb'); mitsuba.load_dict({'type': 'sira_bsdf'})"
    )
    for name in commands():
        statements[f"python -m sira_mi.{name} --help"] = (
            "import runpy, sys, io, contextlib\nsys.argv = ['x', '--help']\n"
            "with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):\n"
            f"    runpy.run_module('sira_mi.{name}', run_name='__main__')"
        )
    heavy = ("mitsuba", "drjit", "numpy", "scipy", "cv2", "skimage", "trimesh")
    for name, statement in statements.items():
        count = f"\nimport sys; print(len(sys.modules), *(m for m in {heavy} if m in sys.modules))"
        seconds = []
        for _ in range(4):
            start = time.perf_counter()
            result = subprocess.run(
                [sys.executable, "-c", statement + count], capture_output=True, text=True, check=True
            )
            seconds.append(time.perf_counter() - start)
        modules, *found = result.stdout.split()
        lines.append(_row(f"`{name}`", f"{np.median(seconds[1:]):.2f}", modules, ", ".join(found) or "none"))
    return "\n".join(lines)


def _relight_sections(cases: list[tuple[str, str, Subject, Light]], size: int, voxel: float) -> list[str]:
    sections = []
    for title, integrator, one, lit in cases:
        settings = RelightSettings(integrator, exact=integrator == "path", voxel=voxel)
        shape = load_head(one, replace(settings, exact=False))
        plan = plan_relight(one, lit, shape, settings, [0.0])
        plan = measure_plan(plan, one, lit, settings, 0.0, size)
        sections.append(f"### {title}\n\n{plan_table(plan)}\n")
        print(f"measured: {title}", flush=True)
    return sections


def _fit_section() -> str:
    settings = QUALITIES["standard"]
    prior = load_avatar(PRIOR)
    with tempfile.TemporaryDirectory() as folder:
        portrait = read_portrait(FitRequest(None, Path(folder), example=True), settings, prior)
        task = FitTask(portrait, prior, PRIOR, settings, Path(folder), settings.plan())
        return plan_table(measure_fit(task, initial_state(prior, 0)))


def write_page(folder: Path, avatar: Path, lights: Path | None, size: int, voxel: float) -> Path:
    """Measures everything and writes `plan.md` into `folder`; InputError when a file cannot be read or written."""
    subject = read_subject(avatar)
    light = read_light(lights, subject.avatar, lobes=True)
    with tempfile.TemporaryDirectory() as work:
        dark = Path(work) / "avatar.safetensors"
        save_avatar(dark, replace(subject.avatar, k_s=0.0))
        matt = replace(subject, path=dark, avatar=load_avatar(dark))
        small = [one.resize(size) for one in (subject, matt)]
        relit = _relight_sections(relight_cases(small[0], light, small[1]), size, voxel)
    text = _page(relit, _fit_section(), _import_table(), size)
    path = folder / "plan.md"
    write_through(path, lambda file: file.write_text(text, encoding="utf-8"))
    return path


def _page(relit: Sequence[str], fit: str, imports: str, size: int) -> str:
    pictures = "\n".join(relit)
    return f"""# What a scene does not need

Before a picture or a fit, a plan is made of what it can do without, and carried out. `--explain` prints it and measures
each decision, `--keep-all` switches it off, and a fit keeps it in `avatar.json` under `plan`. This page is written by

    python -m studies.leave_out AVATAR

Errors of pictures are radiances in units of that of a white diffuse surface which faces the light best. No decision is
taken whose bound exceeds {TOLERANCE:g}, but one: albedos at the vertices instead of networks at every hit, the default
of path tracing, which `--exact` undoes. A bound is on every pixel; what was measured is the root mean square over the
head in a picture of {size} pixels, each decision alone. Where random numbers change along (path tracing; a smaller
film), two seeds of the full picture differ by the "noise" too. The time is the processor's, the median of three pairs
of runs in turn after one that does not count, and half the range of the pairs. Networks at every hit are measured in a
picture of 64 pixels and 4 samples, one after the other: the kernels of every picture hold the networks of all heads
that are alive.

What the bounds rest on:

- **weak lobes**: no surface can reflect more of a lobe than albedo/π times the irradiance where it faces the lobe, plus
  its specular part: at most the largest directional reflectance times the amplitude, and at most the largest f^s cos
  times the lobe's integral. Albedo and reflectance are the largest of 4096 points; for path tracing the bound is
  multiplied by the sum of all bounces, of which below.
- **late bounces**: 4096 points of the mesh look in 64 directions; light that arrives unshadowed at what they see is
  followed from point to point. An estimate, doubled for what lies between the points. With a depth of at most 5,
  Russian roulette never begins.
- **visibility**: what shadows and the bounce change at the same points where the camera sees them, doubled. It applies
  to convex shapes. A head shadows itself under most lights, and even under a flash at the camera, which shows none of
  its shadows, the bounce in its hollows is about 5 % of white at some points.
- **speculars**: left out where k_s is 0, or where the bound of all lobes' specular parts is small. A specular albedo of
  0 is not enough: the Fresnel term still reflects at grazing angles.
- **networks at every hit**: the largest difference of the albedos at the centres of 4096 triangles.
- **a shading for every sample**: the steepest change of radiance, shadows included, between corners and centres of 4096
  triangles, over as far as samples that share a shading may be apart. A head has steeper places than that; `--draft`
  shares shadings whatever it costs.
- **pixels beside the head**: no ray outside the rectangle of the mesh can meet the head. Nothing but the random numbers
  changes.

## Pictures

{pictures}
## The appearance stages of a fit

Errors are the largest differences of the losses' gradient, as a share of its largest entry. All decisions are exact:
what they leave out is 0, or was computed before.

{fit}

Not left out: lobes, because a weak one may grow; and what is computed at a step's own points that does not change, such
as the reflectance in the directions of the shadow rays: for all points of a photo it takes 25 MB a quantity.

## Imports

Seconds of the whole process, Python's own start included. Importing `sira_mi` does not import Mitsuba: the plugins are
registered when Mitsuba is imported.

{imports}
"""
