"""One portrait of the benchmark: the photo path traced with Mitsuba's `principled`, and the truth behind it.

The photo's material is not the one that a fit assumes: its roughness varies by region and identity, and its diffuse
part is Burley's.
"""

from copy import copy
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import binary_dilation

from sira_mi.conventions import LUMINANCE
from sira_mi.portrait.camera import yaw_rotation
from sira_mi.training.collection.render import Part, build_mesh, intrinsic_matrix, look_at, point_towards
from sira_mi.training.collection.skin import CLOTH, EYE, HAIR, SKIN

NOTHING = 255  # region code of pixels off the person
# Ranges that each identity's roughness is drawn from; the fit's is 0.5.
ROUGHNESS = {SKIN: (0.35, 0.55), HAIR: (0.3, 0.5), EYE: (0.05, 0.2), CLOTH: (0.7, 0.9)}
FILM_DIAGONAL = 43.2666  # mm, of the 36 mm x 24 mm frame
ABOVE = 0.35  # scene units between the highest hair and the upper edge of the photo
NOISE_STEP = 0x9E3779B1  # between the seeds of one picture with other noise
LANES = 4_000_000  # paths a launch
JPEG_QUALITY = 95


@dataclass(frozen=True)
class PhotoSettings:
    size: int = 512  # pixels, width and height
    samples: int = 256  # paths a pixel, a power of four
    view_samples: int = 64  # the same, of relit and turned views and of persons in the background
    depth: int = 6  # path length, bounces
    shading_samples: int = 64  # directions a pixel, of the truth's shading and shadow; a power of four
    specular_step: float = 0.05  # specular strengths are rounded to its multiples; 0.004 of reflectance
    noise: int = 0  # another number gives the same pictures with other noise
    jpeg_quality: int = JPEG_QUALITY
    jpeg_subsampling: int = 0  # of the colours: 0 for 4:4:4, 2 for 4:2:0


@dataclass(frozen=True)
class Pose:
    """How an identity is photographed, the same under each light."""

    yaw: float  # degrees about the head, positive to its left
    pitch: float  # degrees, positive from above
    focal_35mm: float  # mm, on film of the same diagonal
    extent: float  # scene units across the photo at the head
    height: float | None = None  # of the photo's middle, scene units; None for what shows the hair from its top down
    aside: float = 0.0  # scene units from the head to the photo's middle, positive to the right in the photo

    @property
    def field_of_view(self) -> float:
        """Degrees across the photo."""
        return 2 * np.degrees(np.arctan(FILM_DIAGONAL / (2 * np.sqrt(2) * self.focal_35mm)))

    @property
    def distance(self) -> float:
        """Scene units from the camera to the head."""
        return self.extent / (2 * np.tan(np.radians(self.field_of_view) / 2))


def find_focal(distance: float, extent: float) -> float:
    """The focal length in mm on 35 mm film of a square photo that shows `extent` across at that distance, both in scene
    units."""
    return FILM_DIAGONAL / np.sqrt(2) * distance / extent


def portrait_camera(parts: list[Part], pose: Pose, size: int) -> tuple[np.ndarray, np.ndarray]:
    """K [3, 3] and world-to-camera [4, 4] of a square photo of `size` pixels."""
    top = max(part.vertices[:, 1].max() for part in parts)
    height = top + ABOVE - pose.extent / 2 if pose.height is None else pose.height
    a = np.radians(pose.yaw)
    target = np.array([0.0, height, 0.0]) + pose.aside * np.array([np.cos(a), 0.0, -np.sin(a)])
    away = point_towards(a, np.radians(pose.pitch))
    return intrinsic_matrix(pose.field_of_view, size), look_at(target + pose.distance * away, target)


def level_parts(part: Part, step: float) -> list[tuple[Part, float]]:
    """A part as pieces of one specular strength each, the triangles' own rounded to multiples of `step`: `principled`
    takes a number for it."""
    levels = np.rint(part.specular[part.triangles].mean(1) / step).astype(int)
    pieces = []
    for level in np.unique(levels):
        chosen = levels == level
        used, corner = np.unique(part.triangles[chosen], return_inverse=True)
        vertex = (part.vertices[used], corner.reshape(-1, 3), part.normals[used], part.albedo[used])
        strength = float(level * step)
        pieces.append((Part(*vertex, np.full(len(used), strength), part.region[chosen]), strength))
    return pieces


def principled_mesh(name: str, part: Part, strength: float, roughness: dict[int, float]) -> "mi.Mesh":
    """A Mitsuba mesh of a part of one specular strength; albedo varies by vertex, `roughness` by region code."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(
        {
            "type": "principled",
            "base_color": {"type": "mesh_attribute", "name": "vertex_albedo"},
            "roughness": {"type": "mesh_attribute", "name": "face_roughness"},
            "specular": strength,
        }
    )
    mesh = build_mesh(name, part, props)
    rough = np.array([roughness[code] for code in range(len(roughness))])[part.region]
    mesh.add_attribute("face_roughness", 1, rough.tolist())
    mesh.add_attribute("face_region", 1, part.region.astype(float).tolist())
    return mesh


def draw_roughness(random: np.random.Generator) -> dict[int, float]:
    """The roughness of one identity by region code."""
    return {code: float(random.uniform(*ROUGHNESS[code])) for code in sorted(ROUGHNESS)}


class View:
    """An identity and its camera. What does not depend on the light is computed once for all photos: `truth`, the
    arrays of the portrait's truth that are known without light."""

    def __init__(self, parts: list[Part], roughness: dict[int, float], K, world_to_camera, settings: PhotoSettings):
        self.settings = settings
        self.K, self.world_to_camera, self.turned = K, world_to_camera, 0.0
        pieces = [piece for part in parts for piece in level_parts(part, settings.specular_step)]
        self.meshes = [principled_mesh(f"part{i}", *piece, roughness) for i, piece in enumerate(pieces)]
        self.scene = self._lit(np.ones((2, 4, 3)))
        self._look()
        self.truth = {
            "K": K.astype(np.float32),
            "world_to_camera": world_to_camera.astype(np.float32),
            "region": self.region,
            "normal": self.normal,
            **self._albedo_maps(),
            **triangle_soup(parts),
        }

    def turn(self, degrees: float) -> "View":
        """The identity turned to its left about the vertical through its own origin, while camera and light stay; they
        are turned about it instead, so that the world remains the identity's own frame. Without `truth`."""
        view = copy(self)
        del view.truth
        rotation = np.eye(4)
        rotation[:3, :3] = yaw_rotation(degrees)
        view.turned, view.world_to_camera = self.turned + degrees, self.world_to_camera @ rotation
        view._look()
        return view

    def _look(self):
        """Finds the covered pixels, and what is at their centres."""
        self.pixels = np.flatnonzero(binary_dilation(self._covered(), np.ones((3, 3), bool)))
        self.region, self.normal, self.position = self._centre_maps()
        self.centres = np.flatnonzero(self.region.reshape(-1) != NOTHING)

    def _lit(self, light):
        scene: dict[str, object] = {f"part{i}": mesh for i, mesh in enumerate(self.meshes)}
        to_world = np.eye(4)
        to_world[:3, :3] = yaw_rotation(-self.turned)
        scene["light"] = {
            "type": "envmap",
            "bitmap": mi.Bitmap(light.astype(np.float32)),
            "mis_compensation": True,
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
        }
        return mi.load_dict({"type": "scene", **scene})

    def _rays(self, pixel, dx, dy):
        """World-space rays through positions (dx, dy) in 0..1 of pixels `pixel`, an index or several."""
        to_world = np.linalg.inv(self.world_to_camera)
        way = to_world[:3, :3] @ np.linalg.inv(self.K)
        x = mi.Float(pixel % self.settings.size) + dx
        y = mi.Float(pixel // self.settings.size) + dy
        direction = [float(row[0]) * x + float(row[1]) * y + float(row[2]) for row in way]
        return mi.RayDifferential3f(mi.Point3f(to_world[:3, 3].tolist()), dr.normalize(mi.Vector3f(*direction)))

    def _covered(self, grid: int = 4):
        """Pixels [H, W] that the person covers somewhere on a grid."""
        size = self.settings.size
        index = dr.arange(mi.UInt32, size * size * grid * grid)
        sub = index % (grid * grid)
        hit = self.scene.ray_test(
            self._rays(
                index // (grid * grid),
                (mi.Float(sub % grid) + 0.5) / grid,
                (mi.Float(sub // grid) + 0.5) / grid,
            )
        )
        return np.array(hit).reshape(size, size, grid * grid).any(-1)

    def _centre_maps(self):
        """Region [H, W], unit normal and position [H, W, 3] of the first hits at pixel centres."""
        size = self.settings.size
        hit = self.scene.ray_intersect(self._rays(dr.arange(mi.UInt32, size * size), 0.5, 0.5))
        valid = hit.is_valid()
        code = dr.select(valid, hit.shape.eval_attribute_1("face_region", hit, valid), NOTHING)
        normal = dr.select(valid, hit.sh_frame.n, 0)
        position = np.array(dr.select(valid, hit.p, 0)).T.reshape(size, size, 3)
        return (
            np.rint(np.array(code)).astype(np.uint8).reshape(size, size),
            np.array(normal).T.astype(np.float32).reshape(size, size, 3),
            position,
        )

    def _albedo_maps(self, grid: int = 4):
        """Diffuse albedo [H, W, 3] and reflectance at normal incidence [H, W]: the means over the covered part of each
        pixel, 0 where nothing is."""
        size = self.settings.size
        index = dr.arange(mi.UInt32, size * size * grid * grid)
        sub = index % (grid * grid)
        rays = self._rays(
            index // (grid * grid), (mi.Float(sub % grid) + 0.5) / grid, (mi.Float(sub // grid) + 0.5) / grid
        )
        hit = self.scene.ray_intersect(rays)
        valid = hit.is_valid()
        albedo = hit.shape.eval_attribute_3("vertex_albedo", hit, valid)
        specular = hit.shape.eval_attribute_1("vertex_specular", hit, valid)
        channels = [dr.select(valid, c, 0) for c in (*albedo, 0.08 * specular, mi.Float(1))]
        dr.eval(channels)
        sums = np.stack([np.array(dr.block_sum(c, grid * grid)) for c in channels], axis=-1).reshape(size, size, 5)
        means = sums[..., :4] / np.maximum(sums[..., 4:], 1)
        return {
            "diffuse_albedo": means[..., :3].astype(np.float32),
            "specular_albedo": means[..., 3].astype(np.float32),
        }

    def directions(self, field_of_view: float | None = None) -> np.ndarray:
        """Unit viewing directions [H, W, 3] of the pixel centres in the world; with `field_of_view`, those of a camera
        that sees so many degrees across."""
        size = self.settings.size
        K = self.K if field_of_view is None else intrinsic_matrix(field_of_view, size)
        x, y = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
        local = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(K).T
        way = local @ self.world_to_camera[:3, :3]
        return way / np.linalg.norm(way, axis=-1, keepdims=True)

    def photograph(self, light: np.ndarray, seed: int, samples: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Linear radiance [H, W, 3] under a map [H, 2H, 3], black off the person (premultiplied), and the coverage
        [H, W] in 0..1; with `samples` paths a pixel, a power of four, instead of those of a photo."""
        self.scene = self._lit(light)
        settings = self.settings
        integrator = mi.load_dict({"type": "path", "max_depth": settings.depth, "hide_emitters": True})

        def sample(sampler, pixel):
            jitter = sampler.next_2d()
            radiance, valid, _ = integrator.sample(self.scene, sampler, self._rays(pixel, jitter.x, jitter.y))
            # A rare sample of `principled` at grazing angles is not a number; it counts as black.
            return [*(dr.select(dr.isfinite(c), c, 0) for c in radiance), dr.select(valid, mi.Float(1), 0)]

        values = self._mean(sample, self.pixels, samples or settings.samples, seed)
        return values[..., :3], np.clip(values[..., 3], 0, 1)

    def shading(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Under the light of the last photograph: diffuse irradiance / pi [H, W, 3] with shadows and interreflections,
        and the share [H, W] of the unoccluded direct irradiance's luminance that arrives; 0 off the person."""
        integrator = mi.load_dict({"type": "path", "max_depth": self.settings.depth - 1, "hide_emitters": True})
        luminance = mi.Color3f(*LUMINANCE)
        environment = self.scene.environment()

        def sample(sampler, pixel):
            hit = self.scene.ray_intersect(self._rays(pixel, 0.5, 0.5))
            normal = hit.sh_frame.n
            # Direct light from two samples by multiple importance sampling (balance heuristic).
            towards, weight = self.scene.sample_emitter_direction(hit, sampler.next_2d(), test_visibility=False)
            cosine = dr.maximum(dr.dot(normal, towards.d), 0) / dr.pi
            first = dr.select(cosine > 0, weight * cosine * towards.pdf / (towards.pdf + cosine), 0)
            around = hit.sh_frame.to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
            cosine = dr.maximum(dr.dot(normal, around), 0) / dr.pi
            escaping = dr.zeros(mi.SurfaceInteraction3f)
            escaping.wi = -around
            asked = dr.zeros(mi.DirectionSample3f)
            asked.d = around
            share = cosine / (cosine + environment.pdf_direction(hit, asked))
            second = dr.select(cosine > 0, environment.eval(escaping) * share, 0)
            # `hide_emitters` leaves only what is reflected.
            bounced, blocked, _ = integrator.sample(self.scene, sampler, mi.RayDifferential3f(hit.spawn_ray(around)))
            bounced = dr.select(dr.isfinite(bounced), bounced, 0)
            arriving = dr.select(self.scene.ray_test(hit.spawn_ray(towards.d)), 0, first)
            arriving += dr.select(blocked, 0, second)
            return [*(arriving + bounced), dr.dot(luminance, arriving), dr.dot(luminance, first + second)]

        values = self._mean(sample, self.centres, self.settings.shading_samples, seed)
        return values[..., :3], values[..., 3] / np.maximum(values[..., 4], 1e-12)

    def _mean(self, sample, pixels, samples, seed):
        """Means [H, W, C] of `sample(sampler, pixel)` at `pixels`, 0 elsewhere; summed in a fixed order."""
        size, count = self.settings.size, len(pixels)
        per_launch = samples
        while per_launch > 1 and count * per_launch > LANES:
            per_launch //= 2
        sampler = mi.load_dict({"type": "ldsampler", "sample_count": samples})
        sampler.set_samples_per_wavefront(per_launch)
        sampler.seed((seed + NOISE_STEP * self.settings.noise) % 2**32, count * per_launch)
        chosen = mi.UInt32(pixels.astype(np.uint32))
        total: np.ndarray | float = 0.0
        for _ in range(samples // per_launch):
            lane = dr.arange(mi.UInt32, count * per_launch)
            channels = sample(sampler, dr.gather(mi.UInt32, chosen, lane // per_launch))
            sampler.advance()
            sampler.schedule_state()
            dr.eval(channels)
            total = total + np.stack([np.array(dr.block_sum(c, per_launch)) for c in channels], axis=-1)
        image = np.zeros((size * size, len(channels)), np.float32)
        image[pixels] = total / samples
        return image.reshape(size, size, -1)


def triangle_soup(parts: list[Part]) -> dict[str, np.ndarray]:
    """`vertices`, `faces` and `face_region` of all parts together."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])
    faces = [part.triangles + offset for part, offset in zip(parts, offsets, strict=False)]
    return {
        "vertices": np.concatenate([part.vertices for part in parts]).astype(np.float32),
        "faces": np.concatenate(faces).astype(np.int32),
        "face_region": np.concatenate([part.region for part in parts]).astype(np.uint8),
    }
