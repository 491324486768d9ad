// Pictures: decoding, tone mapping, error maps. All take linear radiance, red, green and blue of each pixel in turn.
const NAN_COLOUR = [0, 255, 0];
const INFINITE_COLOUR = [0, 255, 255];
const EPSILON = 0.01; // as metrics.rel_mse
const ERROR_LOW = -4; // decades of the error map's scale
const ERROR_HIGH = 1;

const MAGMA_BYTES = bytesOf(MAGMA);
const HALVES = halfTable();

function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

// The value of each of the 65536 half floats.
function halfTable() {
  const table = new Float32Array(65536);
  for (let bits = 0; bits < 65536; bits++) {
    const sign = bits & 0x8000 ? -1 : 1;
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    if (exponent === 31) table[bits] = fraction ? NaN : sign * Infinity;
    else if (exponent === 0) table[bits] = sign * fraction * 2 ** -24;
    else table[bits] = sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
  }
  return table;
}

async function decodePicture(base64) {
  const stream = new Blob([bytesOf(base64)]).stream().pipeThrough(new DecompressionStream("gzip"));
  const view = new DataView(await new Response(stream).arrayBuffer());
  const values = new Float32Array(view.byteLength / 2);
  for (let i = 0; i < values.length; i++) values[i] = HALVES[view.getUint16(2 * i, true)];
  return values;
}

// sRGB coding of linear values 0 to 1, as bytes, in steps that are a twentieth of a byte where it is steepest.
const CODE_STEPS = 65535;
const CODES = Uint8Array.from({ length: CODE_STEPS + 1 }, (_, i) => {
  const x = i / CODE_STEPS;
  return Math.round(255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055));
});

function encode(x) {
  return CODES[x <= 0 ? 0 : x >= 1 ? CODE_STEPS : Math.round(x * CODE_STEPS)];
}

function writeClipped(out, o, r, g, b) {
  out[o] = encode(r);
  out[o + 1] = encode(g);
  out[o + 2] = encode(b);
}

function toCurve(x) {
  return Math.min(Math.max(x / 0.6, 0), 1e6);
}

function hill(x) {
  return (x * (x + 0.0245786) - 0.000090537) / (x * (0.983729 * x + 0.432951) + 0.238081);
}

// preview.tone_map: Hill's fit of the ACES transforms.
function writeFilmic(out, o, r, g, b) {
  r = toCurve(r);
  g = toCurve(g);
  b = toCurve(b);
  const x = hill(0.59719 * r + 0.35458 * g + 0.04823 * b);
  const y = hill(0.076 * r + 0.90834 * g + 0.01566 * b);
  const z = hill(0.0284 * r + 0.13383 * g + 0.83777 * b);
  out[o] = encode(1.60475 * x - 0.53108 * y - 0.07367 * z);
  out[o + 1] = encode(-0.10208 * x + 1.10813 * y - 0.00605 * z);
  out[o + 2] = encode(-0.00327 * x - 0.07276 * y + 1.07602 * z);
}

// The loud colour of a pixel whose sum is NaN or infinite.
function loudColour(r, g, b) {
  return Number.isNaN(r) || Number.isNaN(g) || Number.isNaN(b) ? NAN_COLOUR : INFINITE_COLOUR;
}

function toneMapped(values, stops, curve) {
  const out = new Uint8ClampedArray((values.length / 3) * 4).fill(255);
  const scale = 2 ** stops;
  const write = curve === "filmic" ? writeFilmic : writeClipped;
  for (let i = 0, o = 0; i < values.length; i += 3, o += 4) {
    const r = values[i];
    const g = values[i + 1];
    const b = values[i + 2];
    if (Number.isFinite(r + g + b)) write(out, o, r * scale, g * scale, b * scale);
    else out.set(loudColour(r, g, b), o);
  }
  return out;
}

// Relative squared error of each pixel, a mean over its channels; NaN or infinite where one of the pictures is.
function relativeErrors(values, reference) {
  const errors = new Float32Array(values.length / 3);
  for (let i = 0; i < errors.length; i++) {
    let [sum, total] = [0, 0];
    for (let c = 3 * i; c < 3 * i + 3; c++) {
      sum += (values[c] - reference[c]) ** 2 / (reference[c] ** 2 + EPSILON);
      total += Math.abs(values[c]) + Math.abs(reference[c]);
    }
    errors[i] = Number.isFinite(total) ? sum / 3 : total;
  }
  return errors;
}

function errorColour(error) {
  if (!Number.isFinite(error)) return loudColour(error, error, error);
  const share = error > 0 ? (Math.log10(error) - ERROR_LOW) / (ERROR_HIGH - ERROR_LOW) : 0;
  const index = 3 * Math.round(255 * Math.min(Math.max(share, 0), 1));
  return MAGMA_BYTES.subarray(index, index + 3);
}

function errorMap(errors) {
  const out = new Uint8ClampedArray(errors.length * 4).fill(255);
  for (let i = 0; i < errors.length; i++) out.set(errorColour(errors[i]), 4 * i);
  return out;
}
