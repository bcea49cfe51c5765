#version 450

// The blocks are sapien's: it fills them by these names, and wants them declared in full.

layout(constant_id = 0) const int NUM_DIRECTIONAL_LIGHTS = 0;

layout(set = 2, binding = 0) uniform MaterialBuffer {
  vec4 emission;
  vec4 baseColor;
  float fresnel;
  float roughness;
  float metallic;
  float transmission;
  float ior;
  float transmissionRoughness;
  int textureMask;
  int padding1;
  vec4 textureTransforms[6];
} material;

struct PointLight {
  vec4 position;
  vec4 emission;
};

struct DirectionalLight {
  vec4 direction;
  vec4 emission;
};

struct SpotLight {
  vec4 position;
  vec4 direction;
  vec4 emission;
};

layout(set = 3, binding = 0) uniform SceneBuffer {
  vec4 ambientLight;
  DirectionalLight directionalLights[3];
  SpotLight spotLights[10];
  PointLight pointLights[10];
  SpotLight texturedLights[1];
} scene;

layout(early_fragment_tests) in;  // what is hidden is not shaded

layout(location = 0) in vec3 inNormal;
layout(location = 0) out vec4 outColor;

void main() {
  vec3 normal = normalize(inNormal);
  vec3 light = scene.ambientLight.rgb;
  for (int i = 0; i < NUM_DIRECTIONAL_LIGHTS; ++i) {
    vec3 way = normalize(scene.directionalLights[i].direction.xyz);
    light += max(-dot(normal, way), 0.0) / 3.14159265 * scene.directionalLights[i].emission.rgb;
  }
  outColor = vec4(pow(material.baseColor.rgb * light, vec3(1.0 / 2.2)), 1.0);
}
