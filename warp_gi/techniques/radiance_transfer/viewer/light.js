// Skies of 25 numbers a channel: real spherical harmonics without the Condon-Shortley sign, polar axis z.
const ORDER = 5;
const COUNT = ORDER * ORDER;

function harmonics(x, y, z) {
  const result = new Float64Array(COUNT);
  let re = 1;
  let im = 0;
  let factor = Math.sqrt(1 / (4 * Math.PI));
  for (let m = 0; m < ORDER; m++) {
    if (m > 0) factor *= Math.sqrt((2 * m + 1) / (2 * m));
    let before = 0;
    let value = factor;
    for (let l = m; l < ORDER; l++) {
      if (l > m) {
        const a = Math.sqrt((4 * l * l - 1) / (l * l - m * m));
        const b = l > m + 1 ? a * Math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1)) : 0;
        [before, value] = [value, a * z * value - b * before];
      }
      if (m === 0) {
        result[l * l + l] = value;
      } else {
        result[l * l + l + m] = Math.SQRT2 * value * re;
        result[l * l + l - m] = Math.SQRT2 * value * im;
      }
    }
    [re, im] = [re * x - im * y, im * x + re * y];
  }
  return result;
}

// Rotation by degrees about +y, counter-clockwise seen from above, in rows.
function aboutUp(degrees) {
  const c = Math.cos((degrees * Math.PI) / 180);
  const s = Math.sin((degrees * Math.PI) / 180);
  return [[c, 0, s], [0, 1, 0], [-s, 0, c]];
}

// Light [3][25] of a sky turned by `rotation`: exact, as `sphere` integrates products of harmonics exactly.
function turnedLight(light, rotation, sphere) {
  const result = [0, 1, 2].map(() => new Float64Array(COUNT));
  for (const [x, y, z, weight] of sphere) {
    const [p, q, r] = rotation;
    const old = harmonics(p[0] * x + q[0] * y + r[0] * z, p[1] * x + q[1] * y + r[1] * z, p[2] * x + q[2] * y + r[2] * z);
    const now = harmonics(x, y, z);
    for (let c = 0; c < 3; c++) {
      let value = 0;
      for (let i = 0; i < COUNT; i++) value += light[c][i] * old[i];
      for (let i = 0; i < COUNT; i++) result[c][i] += weight * value * now[i];
    }
  }
  return result;
}

// Light of a sky of radiance 1.
const WHITE = [0, 1, 2].map(() => Float64Array.of(Math.sqrt(4 * Math.PI), ...new Array(COUNT - 1).fill(0)));

// What the four numbers of each layer are multiplied by, a vec4 for red, green and blue each: T by light, bounces by
// light seen through their components. Lamps, in the last layer of T, are no matter of the sky.
function layerWeights(light, components, layers, directLayers) {
  const weights = new Float32Array(layers * 12);
  for (let c = 0; c < 3; c++) {
    for (let i = 0; i < COUNT; i++) weights[(i >> 2) * 12 + c * 4 + (i & 3)] = light[c][i];
    components.forEach((component, k) => {
      let sum = 0;
      for (let i = 0; i < COUNT; i++) sum += component[c][i] * light[c][i];
      weights[(directLayers + (k >> 2)) * 12 + c * 4 + (k & 3)] = sum;
    });
  }
  return weights;
}
