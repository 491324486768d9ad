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

// Halves [channels, height, width] as texels: [layers, height, width, 4], channels that are missing are 0.
async function texelsOf(record) {
  const [planes, count] = await planesOf(record);
  const [channels, height, width] = record.shape;
  const area = height * width;
  const texels = new Uint16Array(Math.ceil(channels / 4) * 4 * area);
  for (let c = 0; c < channels; c++) {
    let from = c * area;
    let to = (c >> 2) * 4 * area + (c & 3);
    for (let i = 0; i < area; i++, from++, to += 4) texels[to] = planes[from] | (planes[from + count] << 8);
  }
  return texels;
}

async function imageOf(record) {
  const blob = new Blob([bytesOf(record.part)], { type: "image/webp" });
  return createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
}
