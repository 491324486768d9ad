"""Khronos' sample models that show one feature each, and what of the table of features they use.

A page of the documentation says from both what is rendered of them. The models are not part of this library.
"""

from __future__ import annotations

VARIANTS, VOLUME = "KHR_materials_variants", "KHR_materials_volume"
TRANSMISSION, CLEARCOAT, SHEEN = "KHR_materials_transmission", "KHR_materials_clearcoat", "KHR_materials_sheen"
SPECULAR, IOR, TRANSFORM = "KHR_materials_specular", "KHR_materials_ior", "KHR_texture_transform"
ANISOTROPY, IRIDESCENCE, LIGHTS = "KHR_materials_anisotropy", "KHR_materials_iridescence", "KHR_lights_punctual"
DIFFUSE_TRANSMISSION, STRENGTH = "KHR_materials_diffuse_transmission", "KHR_materials_emissive_strength"
NODES, PBR, TWO_SETS = (
    "hierarchy and animation of nodes",
    "metallic-roughness materials",
    "two sets of texture coordinates",
)

MODELS: dict[str, tuple[str, ...]] = {
    "AlphaBlendModeTest": ("alphaMode BLEND", "alphaMode MASK"),
    "AnimatedColorsCube": ("KHR_animation_pointer",),
    "AnimatedMorphCube": ("animation of morph weights",),
    "AnimationPointerUVs": ("KHR_animation_pointer", TRANSFORM),
    "AnisotropyBarnLamp": (ANISOTROPY, CLEARCOAT, STRENGTH, TRANSMISSION, VOLUME),
    "AnisotropyStrengthTest": (ANISOTROPY,),
    "AttenuationTest": (TRANSMISSION, VOLUME),
    "BoxVertexColors": ("COLOR_0",),
    "BrainStem": ("skins",),
    "Cameras": ("perspective cameras", "orthographic cameras"),
    "CesiumMan": ("skins",),
    "ClearCoatTest": (CLEARCOAT,),
    "CompareAmbientOcclusion": ("occlusion textures",),
    "CompareEmissiveStrength": (STRENGTH,),
    "CompareTransmission": (TRANSMISSION, "colours of glass"),
    "CompareVolume": (TRANSMISSION, VOLUME),
    "CubeVisibility": ("KHR_node_visibility",),
    "DiffuseTransmissionTest": (DIFFUSE_TRANSMISSION,),
    "DirectionalLight": (LIGHTS,),
    "DispersionTest": (TRANSMISSION, VOLUME, "KHR_materials_dispersion"),
    "EmissiveStrengthTest": (STRENGTH,),
    "EnvironmentTest": (PBR,),
    "Fox": ("skins",),
    "InterpolationTest": (NODES,),
    "IORTestGrid": (TRANSMISSION, VOLUME, IOR),
    "IridescenceDielectricSpheres": (IRIDESCENCE,),
    "LightsPunctualLamp": (LIGHTS,),
    "MaterialsVariantsShoe": (VARIANTS,),
    "MeshPrimitiveModes": ("triangles, strips and fans", "points and lines"),
    "MetalRoughSpheres": (PBR,),
    "MorphPrimitivesTest": ("default weights of morph targets",),
    "MorphStressTest": ("animation of morph weights",),
    "MultiUVTest": (TWO_SETS,),
    "NegativeScaleTest": (NODES,),
    "NormalTangentTest": ("tangents",),
    "OrientationTest": (NODES,),
    "RecursiveSkeletons": ("skins",),
    "RiggedSimple": ("skins",),
    "SheenTestGrid": (SHEEN,),
    "SimpleInstancing": ("EXT_mesh_gpu_instancing",),
    "SimpleMorph": ("animation of morph weights",),
    "SimpleSkin": ("skins",),
    "SimpleSparseAccessor": ("sparse, strided and normalized accessors",),
    "SpecGlossVsMetalRough": ("KHR_materials_pbrSpecularGlossiness",),
    "SpecularTest": (SPECULAR,),
    "TextureLinearInterpolationTest": (PBR,),
    "TextureSettingsTest": ("NEAREST filtering",),
    "TextureTransformMultiTest": (TRANSFORM,),
    "TextureTransformTest": (TRANSFORM,),
    "TransmissionTest": (TRANSMISSION, "colours of glass"),
    "TransmissionThinwallTestGrid": (TRANSMISSION,),
    "UnlitTest": ("KHR_materials_unlit",),
    "VertexColorTest": ("COLOR_0",),
}
"""Features by the name of the model, in the words of ``support.FEATURES``."""
