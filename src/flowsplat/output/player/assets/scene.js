// The embedded scene: from text to arrays of numbers (the layout is that of quantization.py).

/** Base64 to bytes, compressed bytes to plain ones. */
async function inflate(text) {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** All arrays by name: Float32Array of count * components. */
function readArrays(about, bytes) {
  const arrays = {};
  let at = 0;
  const floats = (count) => {
    const part = new Float32Array(bytes.slice(at, at + 4 * count).buffer);
    at += 4 * count;
    return part;
  };
  for (const { name, bits, count, components, chunks, chunk, delta } of about.arrays) {
    const low = floats(chunks * components);
    const step = floats(chunks * components);
    const values = new Float32Array(count * components);
    const mask = bits === 16 ? 0xffff : 0xff;
    for (let c = 0; c < components; c++) {
      const high = at;
      if (bits === 16) at += count;
      let before = 0;
      for (let i = 0; i < count; i++) {
        let q = bits === 16 ? (bytes[high + i] << 8) | bytes[at + i] : bytes[at + i];
        if (delta) q = before = (before + ((q >>> 1) ^ -(q & 1))) & mask;
        const box = Math.floor(i / chunk) * components + c;
        values[i * components + c] = low[box] + step[box] * q;
      }
      at += count;
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
  const arrays = readArrays(about, await inflate(text));
  return {
    about,
    arrays,
    intervals: visibleIntervals(about, arrays),
    objects: placesOfObjects(about, arrays),
    meanDegree: arrays.meanCoefficients.components / 3,
    quatDegree: arrays.quatCoefficients.components / 4,
  };
}
