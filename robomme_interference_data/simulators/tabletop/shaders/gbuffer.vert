#version 450

// The blocks are sapien's: it fills them by these names, and wants them declared in full.

layout(set = 0, binding = 0) uniform CameraBuffer {
  mat4 viewMatrix;
  mat4 projectionMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrixInverse;
  float width;
  float height;
} camera;

layout(set = 1, binding = 0) uniform ObjectTransformBuffer {
  mat4 modelMatrix;
} body;

layout(set = 1, binding = 1) uniform ObjectDataBuffer {
  uvec4 segmentation;
  float transparency;
  int shadeFlat;
} unused;

layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;
layout(location = 3) in vec3 tangent;
layout(location = 4) in vec3 bitangent;

layout(location = 0) out vec3 outNormal;

void main() {
  // Boxes and cylinders are stretched along their axes only, so this keeps the normals' directions.
  outNormal = mat3(body.modelMatrix) * normal;
  vec4 place = camera.viewMatrix * (body.modelMatrix * vec4(position, 1.0));
  gl_Position = camera.projectionMatrix * place;
}
