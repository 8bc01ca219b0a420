// Mouse, touch and keys. They change `state` and nothing else; the loop of main.js draws what it says.

const FLYING = { KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyQ: [0, -1, 0], KeyE: [0, 1, 0] };

const MAX_CLUSTERS = 16;  // that can be chosen: those with the most Gaussians
const DISTANCES = { min: 0.3, max: 3, step: 0.01 };  // times as far from the clip's camera as trained

/** Offer every object alone, and a slider for the distance of each. */
function offerObjects(state) {
  const most = [...state.about.objects].sort((a, b) => b[1] - a[1]).slice(0, MAX_CLUSTERS);
  const numbers = most.map(([number]) => number).sort((a, b) => a - b);
  const sliders = numbers.map((number) => {
    element("part").add(new Option(`object ${number}`, `objects:${number}`));
    const slider = Object.assign(document.createElement("input"), { type: "range", ...DISTANCES, value: 1, id: `distance${number}` });
    const times = Object.assign(document.createElement("output"), { textContent: "1.00" });
    slider.oninput = () => {
      state.setDistance(number, Number(slider.value));
      times.textContent = Number(slider.value).toFixed(2);
    };
    const label = document.createElement("label");
    label.append(`Object ${number} `, slider, " ", times);
    element("distances").insertBefore(label, element("trained"));
    return slider;
  });
  element("distances").hidden = !numbers.length;
  element("trained").onclick = () => {
    for (const slider of sliders) {
      slider.value = 1;
      slider.oninput();
    }
  };
}

const TAP = { seconds: 0.35, pixels: 30 };  // two within these are a double click

class Controls {
  constructor(state, canvas, scene) {
    this.state = state;
    this.canvas = canvas;
    this.frame = 1 / Math.max(scene.about.frames - 1, 1);
    this.pressed = new Set();
    this.pointers = new Map();
    this.tap = null;  // where the last short touch was, and when
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.moved(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.up(event));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("keyup", (event) => this.pressed.delete(event.code));
    addEventListener("blur", () => this.pressed.clear());
  }

  /** The camera is a person's from now on: of one that moves by itself back to the clip's, which can be pulled aside. */
  take() {
    this.state.isHeld = false;
    if (this.state.path) this.state.setMode("clip");
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, event);
    this.canvas.focus();
    this.state.elastic.isPulled = true;
    this.start = this.pointers.size === 1 ? event : null;
  }

  up(event) {
    if (!this.pointers.delete(event.pointerId)) return;
    this.state.elastic.isPulled = this.pointers.size > 0;
    if (this.start?.pointerId !== event.pointerId || event.type !== "pointerup") return;
    // Not by "dblclick": browsers do not tell it of all fingers.
    const near = (other) => {
      const isSoon = event.timeStamp - other.timeStamp < 1000 * TAP.seconds;
      return isSoon && Math.hypot(event.clientX - other.clientX, event.clientY - other.clientY) < TAP.pixels;
    };
    if (!near(this.start)) this.tap = null;
    else if (!this.tap || !near(this.tap)) this.tap = event;
    else {
      this.tap = null;
      this.state.goHome();
    }
  }

  moved(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    this.take();
    const pinch = this.pointers.size === 2 ? this.spread() : null;
    this.pointers.set(event.pointerId, event);
    const pixels = Math.max(this.canvas.clientHeight, 1);
    const [x, y] = [(event.clientX - before.clientX) / pixels, (event.clientY - before.clientY) / pixels];
    const isShift = event.buttons & 6 || event.shiftKey;
    const nearer = pinch === null ? 1 : Math.max(this.spread(), 1) / Math.max(pinch, 1);
    if (this.state.isFree) this.moveFree(x, y, pinch !== null, isShift, nearer);
    else this.pull(x, y, pinch !== null, isShift, nearer);
  }

  pull(x, y, isPinch, isShift, nearer) {
    const { elastic } = this.state;
    const across = x * (this.canvas.clientHeight / Math.max(this.canvas.clientWidth, 1)) * (this.state.isStereo ? 2 : 1);
    if (isPinch) {
      elastic.zoomBy(nearer);
      elastic.shiftBy(across / 2, y / 2);
    } else if (isShift) elastic.shiftBy(across, y);
    else elastic.drag(x, y);
  }

  moveFree(x, y, isPinch, isShift, nearer) {
    const { free } = this.state;
    if (isPinch) {
      free.zoom(1 / nearer);
      free.move([(-x * free.distance) / 2, (-y * free.distance) / 2, 0]);
    } else if (isShift) {
      free.move([-x * free.distance, -y * free.distance, 0]);
    } else if (this.state.mode === "fly") {
      free.turn(-1.5 * x, 1.5 * y);
    } else {
      free.orbit(2 * x, -2 * y);
    }
  }

  spread() {
    const [a, b] = [...this.pointers.values()];
    return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
  }

  wheel(event) {
    if (isEmbedded()) return;  // it scrolls the page round this one
    event.preventDefault();
    this.take();
    const farther = Math.exp(0.0012 * event.deltaY * (event.deltaMode === 1 ? 20 : 1));
    if (this.state.isFree) this.state.free.zoom(farther);
    else this.state.elastic.zoomBy(1 / farther);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { state } = this;
    const isField = ["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName);
    if (event.code in FLYING) {
      state.setMode("fly");
      this.pressed.add(event.code);
    } else if (event.code === "Digit1" || event.code === "KeyR") state.goHome();
    else if (event.code === "Digit2") state.setMode("orbit");
    else if (event.code === "Digit3") state.setMode("fly");
    else if (event.code === "Space" && !isField) state.setPlaying(!state.isPlaying);
    else if (event.code === "ArrowLeft" && !isField) state.seek(state.time - this.frame);
    else if (event.code === "ArrowRight" && !isField) state.seek(state.time + this.frame);
    else return;
    // A list would take a letter or a digit for the first letter of one of its options.
    if (!isField || /^(Key|Digit)/.test(event.code)) event.preventDefault();
  }

  /** What pressed keys do in `seconds`. */
  step(seconds) {
    for (const code of this.pressed) this.state.free.move(FLYING[code].map((value) => 0.5 * value * seconds));
  }
}
