"""What `docs/results.md` says beside its tables of measurements."""

ABLATIONS = """## Ablations

The methods of the paper's Figure 4 and four of this project, all at `{quality}` quality. a.1 and a.2 fit a field
without deformation (H3D-Net): a.1 its latent, a.2 its networks as well. a.3 has deformation and reference, and moves
the deformation's network. In all three the rendering function starts untrained, as in H3D-Net; a.4, where it was
learned with the shapes, is the fit's geometry. b.1 to b.7 go on from a.4: b.1 with untrained decoders, b.2 without
the refinement, b.3 as shipped at that quality, b.4 with the
[shading stage](architecture.md#shape-by-the-light) of the longer qualities, which moves the surface of a.4 too, b.5
polished by path tracing, b.6 as b.3 but with all light of the upper hemisphere at every point: no shadows, and no light
that the head reflects onto itself. b.7 is b.3 as the paper has it, without a refinement of the light: all that base
albedo and light leave of the photo goes to the albedo.
A method without a row was left out by `--methods`. Without a reference space, landmarks have no places on heads of
other shapes: a.1 and a.2 are held by outline and colour alone, and where the outline fits best, the face does least.

"""

GEOMETRY_CHANGES = (
    ("geometry", "on", "face, mm", "no ICP", "hidden half", "normals, °", "IoU"),
    (
        "A photo's exposure is taken out before it is compared with the learned radiance",
        *("six", "1.36 → 1.34", "2.49 → 2.26", "6.9 → 6.3", "10.0 → 9.5", ""),
    ),
    (
        "The rendering function moves from the first step on: one that cannot take the photo's light puts it down to "
        "the shape; a third of the weight of the colour, ten times that of the latents",
        *("nine", "1.43 → 1.26", "2.44 → 2.18", "7.2 → 7.2", "11.4 → 11.4", "0.965 → 0.967"),
    ),
    ("the same", "page, `draft`", "1.26 → 1.26", "2.29 → 2.08", "5.9 → 5.4", "10.3 → 10.3", ""),
    (
        "[Landmarks of the head](benchmark.md#portraits-of-training-heads), found and placed a fifth nearer to the "
        "true ones; the latents' weight of before, so that a head may differ from the mean as real ones do",
        *("nine", "1.26 → 1.26", "2.18 → 2.01", "7.2 → 7.2", "11.4 → 11.4", "0.967 → 0.966"),
    ),
    ("the same", "page, `draft`", "1.26 → 1.24", "2.08 → 2.00", "5.4 → 6.2", "10.3 → 9.6", ""),
    ("the same", "page", "1.25 → 1.24", "2.09 → 1.91", "5.6 → 5.6", "10.5 → 9.6", "0.953 → 0.958"),
    (
        "The mask's loss is over all rays: of IDR's, which leaves out those that hit inside the mask, the derivative "
        "is not that of its values, and heads came out smaller than their outlines",
        *("nine", "1.26 → 1.25", "2.01 → 2.04", "7.2 → 7.5", "11.4 → 11.3", "0.966 → 0.972"),
    ),
    ("Its weight is doubled", "nine", "1.25 → 1.24", "2.04 → 2.04", "7.5 → 7.5", "11.3 → 11.2", "0.972 → 0.980"),
    ("both", "page", "1.24 → 1.26", "1.91 → 1.94", "5.6 → 5.9", "9.6 → 9.8", "0.958 → 0.972"),
    ("both", "page, `draft`", "1.24 → 1.23", "2.00 → 1.96", "6.2 → 5.6", "9.6 → 9.6", "0.955 → 0.967"),
    (
        "Shape by the light: once light and albedo are known, eq. 8 tells latent and deformation of the shape",
        *("nine", "1.25 → 1.13", "2.03 → 1.87", "7.5 → 7.7", "11.3 → 10.7", "0.980 → 0.981"),
    ),
    ("the same", "page", "1.26 → 1.21", "1.94 → 1.88", "5.9 → 6.1", "9.8 → 9.6", "0.972 → 0.973"),
    ("the same, as b.4", "page, `draft`", "1.23 → 1.21", "1.96 → 1.90", "5.6 → 5.7", "9.6 → 9.5", "0.967 → 0.968"),
)

APPEARANCE_CHANGES = (
    ("appearance", "on", "diffuse albedo, dB", "scaled, dB", "final, dB"),
    (
        "The white of the eyes tells the level of the skin's albedo; without the refinement",
        "six",
        "22.7 → 23.2",
        "",
        "",
    ),
    (
        "Ten times as strictly, and at `draft` in twice the steps, which at `standard` gain nothing (24.3 → 24.1)",
        *("six", "23.2 → 24.3", "", ""),
    ),
    (
        "The residual is [shared between albedo and light](architecture.md#albedo-or-light)",
        *("six", "22.5 → 24.8", "24.0 → 26.6", "32.5 → 33.7"),
    ),
    (
        "Eyes of which [one may mislead](benchmark.md#portraits-of-training-heads) in place of their mean",
        *("page", "22.4 → 23.4", "26.5 → 26.5", "35.4 → 35.2"),
    ),
    (
        "Shape by the light; eq. 8 alone 27.5 → 28.7 dB",
        *("page", "23.3 → 23.6", "26.5 → 26.9", "35.5 → 35.1"),
    ),
)

CHANGES = """Before → after, each with all that stands above it; `six` and `nine` are other heads of the test split, at
`draft`, `page` these portraits. How finely such figures tell: with a correction of landmarks measured on 1590 other
photos, which brings those of the nine heads as near, these end at 1.21 instead of 1.26 mm. On nine heads half a tenth
of a millimetre is chance."""

TRIED = """## What was tried against what is missed

On six other heads of the test split, at `draft`, unless said: few, so that figures show a direction rather than a
size. None of this is in the shipped fit.

- **The camera's frame.** The landmark model errs by 4° on average on these heads, and hair over a turned face
  misleads it most: for `makehuman_0199_outdoor` the camera starts 20% too far away, and the head grows with it; since
  outlines count for more, a.4's face of it is off by 1.71 instead of 1.47 mm, b.3's by 1.55. The photo hardly
  corrects a camera: with the true one given, two heads still ended at 1.8 and 2.6 mm in its frame and 0.95 and 1.12
  mm after ICP, with the same losses as from the estimated one. Three times the pose's learning rate: 1.02 → 1.09 and
  0.99 → 0.88 mm. A correction of the landmarks' bias by yaw and pitch, learned from 412 views of 100 training heads,
  or landmarks fitted along with the shape's latents: 4.2° → 4.0° to 4.1°. Landmarks weighted by how much they face
  the camera: no difference on 416 small views of training heads (7.1° both, distance 6.6% → 6.5%). No landmarks after
  the first stage: no difference.
- **An alignment stage** of latents, pose and rendering function, at a quarter of the landmarks' weight, after the first
  (35 to 70 steps, same nine heads): IoU 0.967 → 0.972 to 0.974, camera's frame 2.18 → 2.06 to 2.12, face 1.26 → 1.24 to
  1.27, but head 5.8 → 6.2 to 6.4 and hidden half 7.2 → 7.7 to 8.0; and on the portrait of scikit-image the smile, which
  the prior's closed mouth cannot follow, no longer lies on the mouth. With twice the rates of the pose in all stages:
  1.28 and 2.18 mm. In the first stage three times the landmarks' weight: 1.32 → 1.39 mm, less than half of it 1.38.
  With the landmarks of the head, twice their weight after the first stage: 1.26 → 1.28 mm, camera's frame 2.01 → 2.00,
  hidden half 7.2 → 7.3.
- **Shape and pose by regression** from a photo, ridge on landmarks, features of the landmark network, outline and
  pixels: on 473 small photos of 121 training heads, each head by the others, the pose's error falls from 5.8° to 4.8°
  but the face's shape by 5% only; by true landmarks in place of those found, which are 2.4% of the face's height off,
  it falls by 13% and the pose's error to 2.0° (3.7° where the mean head is laid over them).
- **Landmarks.** Beside the direction, 60 coordinates of the network's own face tell of its errors: 2.3% of the face off
  on 1590 small photos of 409 training heads, by a polynomial of yaw and pitch 1.9%, by the coordinates 1.8%, each head
  by the others; but they take the smile of the portrait of scikit-image for a shape, and its eyes are moved. With true
  landmarks, on the nine heads, all else as shipped but the latents: face 1.11, camera's frame 1.93 mm, with three times
  their weight 1.08 and 1.81: more than landmarks is missing.
- **The face.** More steps leave the prior: twice as many took one portrait of this benchmark from 0.93 to 1.33 mm and
  another head from 1.03 to 0.94; with 260 instead of a draft's 182 two heads ended at 1.10 and 1.82 instead of 0.95 and
  1.47 mm. Weaker rates of the deformation's network, or three times the weight of the prior: within 0.06 mm. Half and a
  quarter of the weight of the colour: 1.37 and 1.34 mm, where 1.34 is shipped. Three seeds each of two photos ended
  within 0.14 mm of each other: there is little that a mean over seeds could take out.
- **Other ways to the shape by the light**, 60 steps on the nine heads (face 1.25, camera's frame 2.03 mm, normals
  11.3° before). Without eq. 8's colour the same steps end at 1.23 mm and 11.7°; with it at weight 1 at 1.14 (twice
  the network's rate: 1.12), weight 3 at 1.09, 1.79 mm and 10.7°, weight 10 at 1.15. With fewer pixels a step and at
  half the photo's size, which saves a third of the time, weight 1.5 has 1.13, 1.87 mm and 10.7°, in 40 steps 1.15. At
  weight 3 the portrait of scikit-image gets a fold under its fringe, at 1.5 and at 2, which is shipped, a fainter
  one. The shape's latent alone: 1.24 mm. Light and albedo moved along: 1.08. The camera too, at weight 1: 1.15,
  camera's frame 2.00 mm, IoU 0.968: it drifts. Half the steps at twice the rates: 1.14. In place of the last geometry
  stage: 1.13. The worst fifth of the pixels left out, on the portrait of scikit-image: the fringe bends at its end.
  On these twelve portraits the gain is less than on the nine: four heads lose (`makehuman_0023_studio` most, 0.94 →
  1.12), eight gain.
- **Normals.** Errors are largest at eyelids, the wings of the nose, the mouth, ears and the edge of the hair: detail
  that the prior does not have. A relief stage, before there was a shading stage (the deformation's network by eq. 8,
  along the photo's rays, each pixel's albedo and all points held), helped here and the albedo (at `standard`, with 182
  steps of geometry and the skin's level by brightness: normals 9.9°, diffuse albedo scaled 26.0 dB), but on the
  portrait of scikit-image it bent brows, eyes and mouth, whose pattern the albedo's prior cannot paint; without these
  three, it bent the fringe. On bare skin only it did not help: normals of the skin 11.4° → 11.6°, where relief
  everywhere had 11.1°, diffuse albedo 22.1 → 22.1 dB, where it had 23.1. What it mended lay at hair, neck and edges. At
  `draft` on all portraits of the benchmark (against b.7, before the light had a refinement): normals 10.2° →
  9.7°, diffuse albedo 21.1 → 22.2 dB (scaled 24.3 → 25.8), final render 31.2 → 31.0.
- **Diffuse albedo.** What is left of its level and colour is the distance between raw and scaled scores. Brightness
  of the skin or of the lit part of the face, alone or together, tells the level hardly: the 97th percentile of the
  face follows the true level with correlation 0.85 on these 12 portraits and with 0.42 on 78 of training heads. The
  colour of the eyes' white says little more of the skin's colour than its level does (log of red over green within
  0.127 instead of 0.129); twice the width for that colour: no difference. The albedo's latent optimised with the light
  from the first stage on: 24.3 → 24.4 dB before the refinement. Half of the points of light, albedo and speculars drawn
  from the face: 24.3 → 24.5 dB before the refinement and 23.5 → 24.2 on skin alone.
- **The refinement** (with all of the residual given to the albedo, b.7, unless said). Two and eight times its shipped
  weight of eq. 12: diffuse albedo 20.5 → 21.0 → 22.1 dB, final render 32.8 → 32.4 → 29.5 (the first figures are of
  half the shipped weight). Four and sixteen times λ8 of eq. 13, its weight in shadows: 22.1 → 22.7 → 23.4 dB, final
  render 32.7 → 31.7 → 29.1. The skin's tone asked of the refined albedo instead of the base: 22.1 → 23.2 dB, final
  render 32.7 → 30.1. The smooth grey part of what b.2 leaves of the photo, taken out of it before: 0.3 dB of the
  scaled albedo for 1.2 dB of the final render. What eq. 8 reaches at all, with its light fitted anew: 26 dB by what
  b.2 finds, 27 by the true albedo, 30 by true albedo and normals, 34 by these and true shadows: the residual is as
  much the light's as the albedo's; it is shared between them in the shipped fit. Shares by the size of the residual
  over the whole photo instead of by the light at each point: diffuse albedo 24.4 dB (scaled 26.0) instead of 24.7
  (26.5), and of the portrait of scikit-image, whose residuals are large, hardly eyes, smile or suit were left. Six
  times the weight that holds the parts to their shares: 24.5 dB with these, final render 30.7."""

COSTS = """Wall-clock time of processes, their start and the writing of scored pictures included; a fit as shipped
is a.4 and b.3 together."""

INTRODUCTION = """# Results of the single-image fit

{portraits} portraits of heads that no training has seen ([benchmark](benchmark.md)), fitted at `{quality}` quality. A
fit sees the photo and its EXIF focal length; camera, mask and landmarks are its own. This page is written by

    python -m studies.portraits build --collection COLLECTION --out BENCHMARK
    python -m studies.portraits fit --benchmark BENCHMARK --runs RUNS --prior-without-deformation PRIOR"""

GEOMETRY = """Distances in mm from points to the other surface, means over portraits; both directions where no
direction is said. `face` is skin and eyes within 95 mm of the nose tip, after six landmarks and ICP with scale (H3DS);
`no ICP` is in the photo's camera frame, with one scale about the camera's centre; `head` is everything above the
shoulders, hair included; `hidden half` is what the photo does not show; IoU leaves out the body below the
model's floor, 30 cm under the ears. The shading stage of b.3 moves the surface of a.4."""

APPEARANCE = """Inside the mask, PSNR and SSIM on sRGB values. `eq. 8` is the final render without the
[refinement of the light](architecture.md#albedo-or-light), which holds in the photo's own light only: what albedo,
light and shape explain by themselves. Specular albedo is the reflectance at normal incidence over 0.08; `scaled` is
after one least-squares factor a channel; `leakage` is the correlation of the log albedo's error on skin with the log
of the light, `of shadows` with the share of light that is not shadowed: 0 is none."""

PICTURE = """## Pictures

Photo and fit; then, each fitted and true, normals, diffuse albedo and specular albedo.

![Photo, fit, and fitted and true normals and albedos](images/results.png)"""
