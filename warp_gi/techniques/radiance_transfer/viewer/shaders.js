// Programs: surfaces, the sky behind them, and the tone curve of the library's previews.
const HEAD = "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2DArray;\n";

const SURFACE_VERTEX = `${HEAD}
layout(location = 0) in vec3 position;
layout(location = 1) in vec2 place;
layout(location = 2) in vec2 uv;
uniform mat4 clipFromWorld;
centroid out vec2 vPlace;
centroid out vec2 vUv;
void main() {
  vPlace = place;
  vUv = vec2(uv.x, 1.0 - uv.y);
  gl_Position = clipFromWorld * vec4(position, 1.0);
}`;

// albedo / pi (L . T + L . B + lamps). A sum of few harmonics swings about what a sky can bring: it is kept to what its
// darkest and its brightest part would bring all over it.
function surfaceFragment(layers, directLayers) {
  return `${HEAD}
const int LAYERS = ${layers};
const int DIRECT = ${directLayers};
centroid in vec2 vPlace;
centroid in vec2 vUv;
uniform sampler2DArray transfer;
uniform sampler2D colorImage;
uniform sampler2D emissionImage;
uniform vec4 weights[3 * LAYERS];
uniform vec4 whites[3 * LAYERS]; // of a sky of radiance 1
uniform vec3 least;
uniform vec3 most;
uniform vec3 color;
uniform vec3 emission;
uniform vec2 coverage; // factor of alpha, and what is a hole below it
uniform float bounced;
out vec4 result;
void main() {
  vec4 base = texture(colorImage, vUv);
  if (base.a * coverage.x < coverage.y) discard;
  vec3 direct = vec3(0.0), indirect = vec3(0.0), lamps = vec3(0.0), open = vec3(0.0), around = vec3(0.0);
  for (int k = 0; k < LAYERS; k++) {
    vec4 texel = texture(transfer, vec3(vPlace, float(k)));
    vec3 light = vec3(dot(texel, weights[3 * k]), dot(texel, weights[3 * k + 1]), dot(texel, weights[3 * k + 2]));
    vec3 white = vec3(dot(texel, whites[3 * k]), dot(texel, whites[3 * k + 1]), dot(texel, whites[3 * k + 2]));
    if (k < DIRECT) {
      direct += light;
      open += white;
    } else {
      indirect += light;
      around += white;
    }
    if (k == DIRECT - 1) lamps = texel.yzw;
  }
  direct = clamp(direct, least * max(open, 0.0), most * max(open, 0.0));
  indirect = max(indirect, least * max(around, 0.0));
  vec3 irradiance = direct + bounced * (indirect + lamps);
  vec3 light = color * base.rgb * irradiance / 3.14159265358979 + emission * texture(emissionImage, vUv).rgb;
  result = vec4(min(light, 65504.0), 1.0);
}`;
}

const SCREEN_VERTEX = `${HEAD}
out vec2 vScreen;
void main() {
  vScreen = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  gl_Position = vec4(vScreen, 1.0, 1.0);
}`;

// Rows of a map are nodes from the zenith to the nadir, columns stand half a texel in.
const SKY_FRAGMENT = `${HEAD}
in vec2 vScreen;
uniform sampler2D map;
uniform mat3 skyFromCamera;
uniform vec2 slopes;
out vec4 result;
void main() {
  vec3 d = normalize(skyFromCamera * vec3(vScreen * slopes, -1.0));
  float u = atan(d.x, -d.z) / 6.28318530717959;
  float v = atan(length(d.xz), d.y) / 3.14159265358979;
  float rows = float(textureSize(map, 0).y);
  result = vec4(textureLod(map, vec2(u, (v * (rows - 1.0) + 0.5) / rows), 0.0).rgb, 1.0);
}`;

const TONE_FRAGMENT = `${HEAD}
uniform sampler2D picture;
uniform float scale;
out vec4 result;
vec3 inward(vec3 c) {
  return vec3(dot(c, vec3(0.59719, 0.35458, 0.04823)), dot(c, vec3(0.07600, 0.90834, 0.01566)),
    dot(c, vec3(0.02840, 0.13383, 0.83777)));
}
vec3 outward(vec3 c) {
  return vec3(dot(c, vec3(1.60475, -0.53108, -0.07367)), dot(c, vec3(-0.10208, 1.10813, -0.00605)),
    dot(c, vec3(-0.00327, -0.07276, 1.07602)));
}
void main() {
  vec3 x = inward(clamp(texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb * scale, 0.0, 1e6));
  x = (x * (x + 0.0245786) - 0.000090537) / (x * (0.983729 * x + 0.4329510) + 0.238081);
  x = clamp(outward(x), 0.0, 1.0);
  result = vec4(mix(1.055 * pow(x, vec3(1.0 / 2.4)) - 0.055, 12.92 * x, lessThanEqual(x, vec3(0.0031308))), 1.0);
}`;
