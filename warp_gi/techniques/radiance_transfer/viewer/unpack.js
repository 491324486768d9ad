// Parts of the page as arrays: parts.py wrote them.

function bytesOf(number) {
  const text = document.getElementById(`part-${number}`).textContent;
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const letters = atob(text);
  const bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  return bytes;
}

async function planesOf(record) {
  const stream = new Blob([bytesOf(record.part)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = record.shape.reduce((product, size) => product * size, 1);
  if (planes.length !== count * record.size) throw new Error(`part ${record.part} of this page is damaged`);
  return [planes, count];
}

// The numbers of a part, in an array of the given type.
async function numbersOf(record, Type) {
  const [planes, count] = await planesOf(record);
  const bytes = new Uint8Array(planes.length);
  for (let k = 0; k < record.size; k++) {
    for (let i = 0, from = k * count, to = k; i < count; i++, to += record.size) bytes[to] = planes[from++];
  }
  return new Type(bytes.buffer);
}

// Halves [3, height, width] as texels [height, width, 4].
async function mapTexels(record) {
  const halves = await numbersOf(record, Uint16Array);
  const area = record.shape[1] * record.shape[2];
  const texels = new Uint16Array(4 * area);
  for (let c = 0; c < 3; c++) for (let i = 0; i < area; i++) texels[4 * i + c] = halves[c * area + i];
  return texels;
}

// A layer of a page, differences [4, height, width] in steps, as texels: Float32Array [height, width, 4].
async function layerTexels(record, steps) {
  const [planes, count] = await planesOf(record);
  const [, height, width] = record.shape;
  const texels = new Float32Array(count);
  for (let c = 0, from = 0; c < 4; c++) {
    for (let y = 0, to = c; y < height; y++) {
      let value = 0;
      for (let x = 0; x < width; x++, from++, to += 4) {
        value = ((value + (planes[from] | (planes[from + count] << 8))) << 16) >> 16;
        texels[to] = value * steps[c];
      }
    }
  }
  return texels;
}

async function imageOf(record) {
  const blob = new Blob([bytesOf(record.part)], { type: "image/webp" });
  return createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
}
