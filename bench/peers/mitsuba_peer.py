"""Mitsuba 3 as a peer: the same scene, camera and settings, rendered by code that nobody here wrote.

A Lambert material becomes Mitsuba's own `diffuse`; glTF metallic-roughness becomes
`GltfBsdf` below, because `roughconductor` shadows each side apart and knows no metallic mix.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Mapping
from ctypes.util import find_library
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_gi import launch
from warp_gi.color import decode_srgb

if TYPE_CHECKING:
    import warp_gi as gi

HOW_TO_INSTALL = "install it with: pip install mitsuba, and for llvm_ad_rgb the package libllvm19 (apt-get install)"
LLVM_PATTERNS = (
    "/usr/lib/*/libLLVM*19*",
    "/usr/lib/llvm-19/lib/libLLVM*",
    "/usr/lib64/libLLVM*19*",
    "/opt/homebrew/opt/llvm@19/lib/libLLVM*.dylib",
)


class PeerMissing(RuntimeError):
    """Mitsuba, or the LLVM that its fast variant compiles with, is not installed."""


LLVM, SCALAR = "llvm_ad_rgb", "scalar_rgb"
"""Variants of Mitsuba: kernels compiled for vectors by LLVM, and scalar code that traces a ray at a time."""


def load_mitsuba(variant: str = LLVM) -> Any:
    """Return the module ``mitsuba`` with ``variant`` set, until another is loaded, and with as many threads as we use.

    Finds LLVM 19 unless DRJIT_LIBLLVM_PATH names one. Raises PeerMissing with what to install.
    """
    mitsuba = _started(variant)
    mitsuba.set_variant(variant)
    import drjit

    drjit.set_thread_count(launch.thread_count())
    return mitsuba


@cache
def _started(variant: str) -> Any:
    if variant.startswith("llvm") and not os.environ.get("DRJIT_LIBLLVM_PATH"):
        found = sorted(path for pattern in LLVM_PATTERNS for path in glob.glob(pattern))
        library = found[0] if found else find_library("LLVM-19")
        if not library:
            raise PeerMissing(f"Mitsuba {variant} found no LLVM 19; {HOW_TO_INSTALL}")
        os.environ["DRJIT_LIBLLVM_PATH"] = library
    try:
        import mitsuba
    except ImportError as error:
        raise PeerMissing(f"no module mitsuba; {HOW_TO_INSTALL}") from error
    try:
        mitsuba.set_variant(variant)
    except ImportError as error:
        raise PeerMissing(f"Mitsuba variant {variant} does not start ({error}); {HOW_TO_INSTALL}") from error
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    _register(mitsuba)
    return mitsuba


def renderer(
    scene: gi.Scene, camera: gi.Camera, integrator: Mapping[str, Any], spp: int, variant: str = LLVM
) -> Callable[[int], np.ndarray]:
    """Return a function of a seed that renders float32 [height, width, 3]; raises as ``to_mitsuba``."""
    mi = load_mitsuba(variant)
    peer, method = to_mitsuba(scene, camera, variant), mi.load_dict(dict(integrator))

    def render(seed: int) -> np.ndarray:
        return np.array(load_mitsuba(variant).render(peer, integrator=method, spp=spp, seed=seed))

    return render


def _register(mi: Any) -> None:
    import drjit as dr

    class GltfBsdf(mi.BSDF):
        """glTF 2.0 Appendix B: Lambert under GGX with height-correlated Smith and Schlick; reflects on both sides."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.base = props.get_texture("base_color", 0.8)
            self.metallic = props.get_texture("metallic", 0.0)
            self.roughness = props.get_texture("roughness", 1.0)
            self.specular = float(props.get("specular", 1.0))
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [mi.BSDFFlags.DiffuseReflection | sides, mi.BSDFFlags.GlossyReflection | sides]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def _value(self, wi: Any, wo: Any, si: Any, active: Any) -> tuple[Any, Any]:
            """Return BSDF times cosine, and the density of `sample`; both directions are on the upper side."""
            base, metallic = self.base.eval(si, active), self.metallic.eval_1(si, active)
            roughness = self.roughness.eval_1(si, active)
            alpha = dr.maximum(roughness * roughness, 1e-3)
            half = dr.normalize(wi + wo)
            cos_i, cos_o, cos_d = mi.Frame3f.cos_theta(wi), mi.Frame3f.cos_theta(wo), dr.dot(wi, half)
            distribution = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True)
            squared = alpha * alpha
            root_i = cos_o * dr.sqrt(squared + (1.0 - squared) * cos_i * cos_i)
            root_o = cos_i * dr.sqrt(squared + (1.0 - squared) * cos_o * cos_o)
            visible = 0.5 / (root_i + root_o)  # height-correlated Smith G2 / (4 cos_i cos_o)
            f0 = dr.lerp(mi.Color3f(0.04 * self.specular), base, metallic)
            f90 = dr.lerp(self.specular, 1.0, metallic)
            fresnel = f0 + (f90 - f0) * (1.0 - dr.clip(cos_d, 0.0, 1.0)) ** 5
            diffuse = dr.lerp(base, mi.Color3f(0.0), metallic)
            value = (1.0 - fresnel) * diffuse * dr.inv_pi + fresnel * (distribution.eval(half) * visible)
            glossy = self._glossy(cos_i, base, metallic)
            pdf = dr.lerp(cos_o * dr.inv_pi, distribution.pdf(wi, half) / (4.0 * cos_d), glossy)
            valid = active & (cos_i > 0.0) & (cos_o > 0.0)
            return dr.select(valid, value * cos_o, 0.0), dr.select(valid, pdf, 0.0)

        def _glossy(self, cos_i: Any, base: Any, metallic: Any) -> Any:
            """Return the probability of sampling the GGX lobe: its share of the reflectance, as our path tracer's."""
            tail = (1.0 - dr.clip(cos_i, 0.0, 1.0)) ** 5
            f0 = dr.lerp(mi.Color3f(0.04 * self.specular), base, metallic)
            fresnel = mi.luminance(dr.lerp(f0, mi.Color3f(dr.lerp(self.specular, 1.0, metallic)), tail))
            diffuse = mi.luminance(dr.lerp(base, mi.Color3f(0.0), metallic)) * (1.0 - fresnel)
            return dr.select(diffuse > 0.0, dr.maximum(fresnel / (fresnel + diffuse), 0.05), 1.0)

        def _sides(self, si: Any, wo: Any) -> tuple[Any, Any]:
            side = dr.mulsign(mi.Float(1.0), mi.Frame3f.cos_theta(si.wi))
            flip = mi.Vector3f(1.0, 1.0, side)
            return si.wi * flip, wo * flip

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            wi, _ = self._sides(si, si.wi)
            roughness = self.roughness.eval_1(si, active)
            alpha = dr.maximum(roughness * roughness, 1e-3)
            distribution = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True)
            normal, _ = distribution.sample(wi, sample2)
            reflected = normal * (2.0 * dr.dot(wi, normal)) - wi
            base, metallic = self.base.eval(si, active), self.metallic.eval_1(si, active)
            glossy = sample1 < self._glossy(mi.Frame3f.cos_theta(wi), base, metallic)
            wo = dr.select(glossy, reflected, mi.warp.square_to_cosine_hemisphere(sample2))
            value, pdf = self._value(wi, wo, si, active)
            bs = mi.BSDFSample3f()
            bs.wo = self._sides(si, wo)[1]
            bs.pdf = pdf
            bs.eta = 1.0
            bs.sampled_type = dr.select(
                glossy, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            )
            bs.sampled_component = dr.select(glossy, mi.UInt32(1), mi.UInt32(0))
            return bs, dr.select(pdf > 0.0, value / pdf, 0.0) & active

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._value(*self._sides(si, wo), si, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._value(*self._sides(si, wo), si, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            return self._value(*self._sides(si, wo), si, active)

        def to_string(self) -> str:
            return "GltfBsdf[]"

    class Coverage(mi.Texture):
        """1 where the nested texture times ``scale`` reaches ``cutoff``, else 0: glTF's alpha mode MASK."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.nested = props.get_texture("nested", 1.0)
            self.cutoff = float(props["cutoff"])

        def eval_1(self, si: Any, active: Any = True) -> Any:
            return dr.select(self.nested.eval_1(si, active) >= self.cutoff, 1.0, 0.0)

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.Color3f(self.eval_1(si, active))

        def is_spatially_varying(self) -> bool:
            return True

        def to_string(self) -> str:
            return "Coverage[]"

    mi.register_bsdf("gltf", GltfBsdf)
    mi.register_texture("coverage", Coverage)


def to_mitsuba(scene: gi.Scene, camera: gi.Camera, variant: str = LLVM) -> Any:
    """Return ``scene`` at its current time seen by ``camera`` as a ``mi.Scene``: box filter, independent sampler.

    Raises PeerMissing without Mitsuba, and ValueError for what it has no equal for: normal
    maps, emission by texture or on both sides, punctual lights.
    """
    if scene.lights:
        raise ValueError("punctual lights are not converted; take them off first")
    mi = load_mitsuba(variant)
    geometry = scene.data("cpu").geometry
    arrays = {name: getattr(geometry, name).numpy() for name in ("points", "normals", "uvs", "indices", "materials")}
    parts: dict[str, Any] = {"type": "scene", "sensor": _sensor(mi, camera)}
    if scene.environment is not None and not scene.environment.is_black:
        parts["sky"] = _environment(mi, scene.environment)
    for index, material in enumerate(scene.materials):
        faces = arrays["indices"][arrays["materials"] == index]
        if len(faces):
            parts[f"mesh{index}"] = _mesh(mi, f"mesh{index}", arrays, faces, material)
    return mi.load_dict(parts)


def _sensor(mi: Any, camera: gi.Camera) -> dict[str, Any]:
    to_world = camera.world_from_camera @ np.diag(
        [-1.0, 1.0, -1.0, 1.0]
    )  # Mitsuba's cameras look along +z, x to the left
    width, height = camera.resolution
    film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb", "component_format": "float32"}
    film["rfilter"] = {"type": "box"}
    return {
        "type": "perspective",
        "fov": camera.hfov,
        "fov_axis": "x",
        "near_clip": 1e-3,
        "far_clip": 1e5,
        "to_world": mi.ScalarTransform4f(to_world),
        "film": film,
        "sampler": {"type": "independent"},
    }


def _environment(mi: Any, environment: gi.Environment) -> dict[str, Any]:
    if environment.pixels is None:
        return {"type": "constant", "radiance": _rgb(environment.mean_radiance)}
    to_world = np.eye(4)
    to_world[:3, :3] = environment.world_from_environment
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(environment.pixels, dtype=np.float32)),
        "scale": float(environment.scale),
        "to_world": mi.ScalarTransform4f(to_world),
    }


def _mesh(mi: Any, name: str, arrays: dict[str, np.ndarray], faces: np.ndarray, material: gi.Material) -> Any:
    vertices, faces = np.unique(faces, return_inverse=True)
    normals = arrays["normals"][vertices]
    smooth = bool(np.any(normals))
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(_bsdf(mi, material))
    if any(material.emission):
        if material.emission_texture is not None or material.double_sided:
            raise ValueError(f"material {material.name}: Mitsuba's area light emits one colour from one side")
        properties["mesh_emitter"] = mi.load_dict({"type": "area", "radiance": _rgb(material.emission)})
    properties["face_normals"] = not smooth
    mesh = mi.Mesh(name, len(vertices), faces.size // 3, properties, smooth, True)
    buffers = mi.traverse(mesh)
    buffers["vertex_positions"] = arrays["points"][vertices].ravel()
    buffers["faces"] = faces.ravel().astype(np.uint32)
    buffers["vertex_texcoords"] = arrays["uvs"][vertices].ravel()
    if smooth:
        buffers["vertex_normals"] = normals.ravel()
    buffers.update()
    return mesh


def _bsdf(mi: Any, material: gi.Material) -> dict[str, Any]:
    if material.normal_texture is not None:
        raise ValueError(f"material {material.name}: normal maps are not converted; take them off first")
    base = _color(mi, material.base_color, material.base_color_texture)
    if material.specular == 0.0 and material.metallic == 0.0:
        bsdf: dict[str, Any] = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": base}}
    else:
        image = material.metallic_roughness_texture
        channel = None if image is None else image.pixels.astype(np.float32) / 255.0
        bsdf = {
            "type": "gltf",
            "base_color": base,
            "metallic": _number(mi, material.metallic, image, channel, 2),
            "roughness": _number(mi, material.roughness, image, channel, 1),
            "specular": float(material.specular),
        }
    image = material.base_color_texture
    if not material.lets_rays_pass:
        return bsdf
    alpha = None if image is None else image.pixels.astype(np.float32) / 255.0
    if material.alpha_blend:
        return {"type": "mask", "opacity": _number(mi, material.alpha, image, alpha, 3), "nested": bsdf}
    coverage = {
        "type": "coverage",
        "nested": _number(mi, material.alpha, image, alpha, 3),
        "cutoff": material.alpha_cutoff,
    }
    return {"type": "mask", "opacity": coverage, "nested": bsdf}


def _rgb(color: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(c) for c in color]}


def _color(mi: Any, factor: Any, image: gi.Texture | None) -> dict[str, Any]:
    if image is None:
        return _rgb(factor)
    coded = image.pixels[..., :3].astype(np.float32) / 255.0
    linear = decode_srgb(coded) if image.srgb else coded
    return _bitmap(mi, linear * np.asarray(factor, dtype=np.float32), image)


def _number(mi: Any, factor: float, image: gi.Texture | None, pixels: np.ndarray | None, channel: int) -> Any:
    if image is None or pixels is None:
        return float(factor)
    return _bitmap(mi, pixels[..., channel : channel + 1] * factor, image)


def _bitmap(mi: Any, pixels: np.ndarray, image: gi.Texture) -> dict[str, Any]:
    if image.wrap[0] != image.wrap[1]:
        raise ValueError(f"texture {image.name}: Mitsuba wraps u and v alike")
    upright = np.ascontiguousarray(pixels[::-1], dtype=np.float32)  # Mitsuba's row 0 is at v = 0, ours at v = 1
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(upright),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": image.wrap[0],
    }
