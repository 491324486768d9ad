// Parts of the page as arrays: parts.py wrote them.

function bytesOf(number) {
  const text = document.getElementById(`part-${number}`).textContent;
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const letters = atob(text);
  const bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  return bytes;
}

// Bits of the numbers of a part, as whole ones: kept are differences along the last axis, lowest bytes first.
async function numbersOf(record) {
  const stream = new Blob([bytesOf(record.part)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = record.shape.reduce((product, size) => product * size, 1);
  if (planes.length !== count * record.size) throw new Error(`part ${record.part} of this page is damaged`);
  const numbers = record.size === 2 ? new Uint16Array(count) : new Uint32Array(count);
  const width = record.shape.at(-1);
  for (let first = 0; first < count; first += width) {
    let value = 0;
    for (let i = first; i < first + width; i++) {
      let difference = 0;
      for (let k = record.size - 1; k >= 0; k--) difference = (difference << 8) | planes[k * count + i];
      value = (value + difference) | 0;
      numbers[i] = value;
    }
  }
  return numbers;
}

// Numbers [channels, n] as [n, size], those of channels that are missing 0.
function interleaved(numbers, channels, size = channels) {
  const count = numbers.length / channels;
  const result = new numbers.constructor(count * size);
  for (let c = 0, from = 0; c < channels; c++) {
    for (let i = 0, to = c; i < count; i++, to += size) result[to] = numbers[from++];
  }
  return result;
}

// A layer of a page, multiples of steps [4, height, width], as texels: Float32Array [height, width, 4].
async function layerTexels(record, steps) {
  const numbers = interleaved(await numbersOf(record), 4);
  return Float32Array.from(numbers, (number, i) => ((number << 16) >> 16) * steps[i & 3]);
}

async function imageOf(record) {
  const blob = new Blob([bytesOf(record.part)], { type: "image/webp" });
  return createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
}
