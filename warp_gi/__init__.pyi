"""What ``warp_gi/__init__.py`` loads on first use, for type checkers and editors, which cannot follow that.

One line a name. A test compares them with ``warp_gi.__all__``.
A technique may lack its line: it works, and only checkers do not see it.
"""

from warp_gi import metrics as metrics
from warp_gi.baking import Bake as Bake
from warp_gi.baking import load_bake as load_bake
from warp_gi.bvh import AlphaMasks as AlphaMasks
from warp_gi.bvh import Hits as Hits
from warp_gi.bvh import TriangleBvh as TriangleBvh
from warp_gi.camera_rays import CameraHits as CameraHits
from warp_gi.camera_rays import trace_cameras as trace_cameras
from warp_gi.denoise import Denoiser as Denoiser
from warp_gi.denoise import Oidn as Oidn
from warp_gi.denoise import SpatioTemporal as SpatioTemporal
from warp_gi.errors import BakeError as BakeError
from warp_gi.errors import GiError as GiError
from warp_gi.errors import OptionError as OptionError
from warp_gi.errors import SceneError as SceneError
from warp_gi.errors import UnsupportedWarning as UnsupportedWarning
from warp_gi.estimator import Estimator as Estimator
from warp_gi.frame import Frame as Frame
from warp_gi.kept import BakeFolder as BakeFolder
from warp_gi.launch import set_threads as set_threads
from warp_gi.pipeline import Pipeline as Pipeline
from warp_gi.primary import Primary as Primary
from warp_gi.radiance_cache import RadianceCache as RadianceCache
from warp_gi.rendering import bake as bake
from warp_gi.rendering import plan_sequence as plan_sequence
from warp_gi.rendering import render as render
from warp_gi.scene.builtin import builtin_camera_path as builtin_camera_path
from warp_gi.scene.builtin import builtin_scene as builtin_scene
from warp_gi.scene.camera import CameraKey as CameraKey
from warp_gi.scene.camera import CameraPath as CameraPath
from warp_gi.scene.environment import Environment as Environment
from warp_gi.scene.environment import SunSky as SunSky
from warp_gi.scene.loading import load_scene as load_scene
from warp_gi.scene.model import Keyframe as Keyframe
from warp_gi.scene.model import Material as Material
from warp_gi.scene.model import Mesh as Mesh
from warp_gi.scene.model import MorphKeyframe as MorphKeyframe
from warp_gi.scene.model import MorphTarget as MorphTarget
from warp_gi.scene.model import Node as Node
from warp_gi.scene.model import PunctualLight as PunctualLight
from warp_gi.scene.model import Skin as Skin
from warp_gi.scene.model import Texture as Texture
from warp_gi.scene.pinhole import Camera as Camera
from warp_gi.scene.scene import Scene as Scene
from warp_gi.scene.sky_motion import SkySequence as SkySequence
from warp_gi.scene.sky_motion import TurningSky as TurningSky
from warp_gi.scheduler import FrameScheduler as FrameScheduler
from warp_gi.sequence.frames import read_frame as read_frame
from warp_gi.sequence.frames import write_frame as write_frame
from warp_gi.sequence.resume import Plan as Plan
from warp_gi.shards import merge_bakes as merge_bakes
from warp_gi.stateful import Service as Service
from warp_gi.techniques.light_field.estimator import LightFieldProbes as LightFieldProbes
from warp_gi.techniques.light_hierarchy.estimator import LightHierarchy as LightHierarchy
from warp_gi.techniques.paths.estimators import BsdfPaths as BsdfPaths
from warp_gi.techniques.paths.estimators import PowerLights as PowerLights
from warp_gi.techniques.paths.estimators import TracedEnvironment as TracedEnvironment
from warp_gi.techniques.paths.estimators import UniformLights as UniformLights
from warp_gi.techniques.radiance_transfer.estimator import RadianceTransfer as RadianceTransfer
from warp_gi.techniques.reuse.guided_paths import GuidedPaths as GuidedPaths
from warp_gi.techniques.reuse.light_cache import VisibilityLightCache as VisibilityLightCache
from warp_gi.techniques.reuse.pictures import reuse_pictures as reuse_pictures
from warp_gi.techniques.reuse.sample_octree import SampleOctree as SampleOctree
from warp_gi.techniques.surface_cache.cache import SurfaceCache as SurfaceCache
from warp_gi.techniques.visibility_field.estimator import VisibilityField as VisibilityField
from warp_gi.techniques.visibility_polygons.estimator import VisibilityPolygons as VisibilityPolygons
from warp_gi.trimesh_rays import RayMeshIntersector as RayMeshIntersector
from warp_gi.verbosity import set_verbosity as set_verbosity

__version__: str
__all__: list[str]
