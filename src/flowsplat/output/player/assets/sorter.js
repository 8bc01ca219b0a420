// Which Gaussians are seen at a time, farthest first. The function is the whole program of a worker: it uses nothing from outside.

function sorterProgram(post) {
  let scene = null;
  let depths, bits, rows, other, histogram;

  function load(message) {
    scene = message;
    const count = scene.resting + scene.moving;
    depths = new Float32Array(count);
    bits = new Uint32Array(depths.buffer);
    rows = new Uint32Array(count);
    other = new Uint32Array(count);
    histogram = new Uint32Array(65536);
  }

  /**
   * Fill `depths`, and `rows` with those of a part in front of the near plane that are present; returns how many.
   * Objects are `factors` times as far away from the pivot (0: of no object).
   */
  function measure([x, y, z, w], time, { part, only }, pivot, factors) {
    const { means, coefficients, degree, intervals, objects, pMin, near } = scene;
    const resting = part === "objects" && !only ? 0 : scene.resting;
    const moving = part === "background" ? 0 : scene.moving;
    const across = x * pivot[0] + y * pivot[1] + z * pivot[2];
    let active = 0;
    for (let i = 0; i < resting; i++) {
      if (only && objects[i] !== only) continue;
      const seen = x * means[3 * i] + y * means[3 * i + 1] + z * means[3 * i + 2];
      const depth = across + factors[objects[i]] * (seen - across) + w;
      if (depth > near) {
        depths[i] = depth;
        rows[active++] = i;
      }
    }
    const reach = 2 * Math.log(1 / pMin) * (1 + 1e-5);
    for (let j = 0; j < moving; j++) {
      const tau = time - intervals[4 * j + 2];
      if (intervals[4 * j + 3] * tau * tau > reach) continue;
      const i = scene.resting + j;
      if (only && objects[i] !== only) continue;
      let seen = x * means[3 * i] + y * means[3 * i + 1] + z * means[3 * i + 2];
      const s = (time - intervals[4 * j]) * intervals[4 * j + 1];
      let before = 1;
      let now = s;
      for (let k = 0, at = 3 * degree * j; k < degree; k++, at += 3) {
        seen += now * (x * coefficients[at] + y * coefficients[at + 1] + z * coefficients[at + 2]);
        const next = 2 * s * now - before;
        before = now;
        now = next;
      }
      const depth = across + factors[objects[i]] * (seen - across) + w;
      if (depth > near) {
        depths[i] = depth;
        rows[active++] = i;
      }
    }
    return active;
  }

  /** One stable counting sort of `from` into `to`, largest first, by 16 of the bits of the depths. */
  function pass(from, to, count, shift) {
    histogram.fill(0);
    for (let k = 0; k < count; k++) histogram[(bits[from[k]] >>> shift) & 0xffff]++;
    for (let key = 65535, start = 0; key >= 0; key--) {
      const here = histogram[key];
      histogram[key] = start;
      start += here;
    }
    for (let k = 0; k < count; k++) to[histogram[(bits[from[k]] >>> shift) & 0xffff]++] = from[k];
  }

  /** Rows of the active Gaussians, farthest first: positive floats are in the order of their bits. */
  function sort({ row, time, shown, pivot, factors, ticket }) {
    const active = measure(row, time, shown, pivot, factors);
    pass(rows, other, active, 0);
    pass(other, rows, active, 16);
    const order = rows.slice(0, active);
    post({ order, ticket }, [order.buffer]);
  }

  return (message) => (message.means ? load(message) : sort(message));
}

/** Sorts in a worker, or on this thread where a page from disk may not start one. */
class Sorter {
  constructor(scene) {
    const { about, arrays, intervals, objects, meanDegree } = scene;
    this.waiting = new Map();
    this.ticket = 0;
    const receive = (answer) => {
      this.waiting.get(answer.ticket).resolve(answer.order);
      this.waiting.delete(answer.ticket);
    };
    const load = {
      resting: about.resting, moving: about.moving, means: arrays.means.values, coefficients: arrays.meanCoefficients.values,
      degree: meanDegree, intervals, objects, pMin: about.pMin, near: about.near,
    };
    const sortHere = () => {
      const handle = sorterProgram(receive);
      this.send = (message) => queueMicrotask(() => handle(message));
    };
    try {
      const source = `const handle = (${sorterProgram})((answer, moved) => postMessage(answer, moved)); onmessage = (event) => handle(event.data);`;
      const worker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
      worker.onmessage = (event) => receive(event.data);
      // A page may be allowed to make a worker and not to start it: that is told later.
      worker.onerror = () => {
        worker.terminate();
        sortHere();
        this.send(load);
        for (const { message } of this.waiting.values()) this.send(message);
      };
      this.send = (message) => worker.postMessage(message);
    } catch {
      sortHere();
    }
    this.send(load);
  }

  /**
   * Promise of the order at a time of what is shown ({ part, only }: the place of the one object, or 0), for a camera with this
   * third row of its viewmat, with every object so many times as far away from the pivot.
   */
  sort(row, time, shown, { pivot, factors }) {
    const message = { row, time, shown, pivot, factors, ticket: this.ticket++ };
    return new Promise((resolve) => {
      this.waiting.set(message.ticket, { resolve, message });
      this.send(message);
    });
  }
}
