// The embedded scene: from text to arrays of numbers (the layout is that of quantization.py).

// As text_encoding.py.
const FORBIDDEN = [0, 9, 10, 11, 12, 13, 26, 27, 32, 34, 38, 60, 62, 92, 127];

/** Text to bytes: a character has seven bits, from 128 on it has two of FORBIDDEN's and others'. */
function decodeText(text, count) {
  const bytes = new Uint8Array(count);
  let at = 0, bits = 0, held = 0;
  const take = (seven) => {
    held = ((held << 7) | seven) & 0x7fff;
    bits += 7;
    if (bits >= 8) bytes[at++] = held >> (bits -= 8);
  };
  for (let i = 0; i < text.length; i++) {
    const character = text.charCodeAt(i);
    if (character >= 128) take(FORBIDDEN[(character >> 7) - 1]);
    take(character & 127);
  }
  return bytes;
}

/** Compressed bytes to plain ones. */
async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** All arrays by name: Float32Array of count * components. */
function readArrays(about, bytes) {
  const arrays = {};
  let at = 0;
  for (const { name, bits, count, components, chunk, delta } of about.arrays) {
    const chunks = Math.ceil(count / chunk);
    const step = new Float32Array(bytes.slice(at, at + 4 * chunks * components).buffer);
    at += 4 * chunks * components;
    const values = new Float32Array(count * components);
    const planes = bits / 8;
    for (let c = 0; c < components; c++) {
      let before = 0;
      for (let i = 0; i < count; i++) {
        let z = 0;
        for (let k = 0; k < planes; k++) z = (z << 8) | bytes[at + k * count + i];
        let q = (z >>> 1) ^ -(z & 1);
        if (delta) q = before = i % chunk ? before + q : q;
        values[i * components + c] = step[c * chunks + Math.floor(i / chunk)] * q;
      }
      at += planes * count;
    }
    arrays[name] = { values, components };
  }
  return arrays;
}

/** Per moving Gaussian: middle and 1 / half length of its visible interval, center time, precision (as chebyshev.py). */
function visibleIntervals(about, arrays) {
  const intervals = new Float32Array(4 * about.moving);
  for (let i = 0; i < about.moving; i++) {
    const center = arrays.times.values[i];
    const precision = Math.exp(arrays.logLambdas.values[i]);
    const reach = Math.sqrt((-2 * Math.log(about.pMin)) / precision);
    const start = Math.max(center - reach, 0);
    const end = Math.min(center + reach, 1);
    intervals.set([(start + end) / 2, 1 / Math.max((end - start) / 2, 1e-6), center, precision], 4 * i);
  }
  return intervals;
}

/** Per Gaussian the place of its object in `about.objects`, from 1; 0: it belongs to none. */
function placesOfObjects(about, arrays) {
  const places = new Uint8Array(about.resting + about.moving);
  const placeOf = new Map(about.objects.map(([number], k) => [number, k + 1]));
  if (arrays.object_ids) arrays.object_ids.values.forEach((number, i) => (places[i] = placeOf.get(number) ?? 0));
  return places;
}

/** The scene as the renderer and the sorter want it. */
async function readScene(about, text) {
  const arrays = readArrays(about, await inflate(decodeText(text, about.bytes)));
  return {
    about,
    arrays,
    intervals: visibleIntervals(about, arrays),
    objects: placesOfObjects(about, arrays),
    meanDegree: arrays.meanCoefficients.components / 3,
    quatDegree: arrays.quatCoefficients.components / 4,
  };
}
