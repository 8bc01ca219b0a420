// The page: unpack the scene, then draw whenever time or camera have changed.

const element = (id) => document.getElementById(id);

function complain(error) {
  element("message").textContent = error.message ?? String(error);
  element("message").hidden = false;
  document.body.classList.add("failed");
}

/** What is to be seen: time, camera, and whether it plays. The buttons always show it. */
class State {
  constructor(about) {
    this.about = about;
    this.time = 0;
    this.isPlaying = true;
    this.speed = 1;
    this.mode = "clip";
    this.part = "all";
    this.isStereo = false;
    this.isConfidenceFade = false;
    this.factors = [1, ...about.objects.map(() => 1)];  // by the place of the object; the first is of what belongs to none
    this.knowsGuesses = about.arrays.some(({ name }) => name === "logReaches");
    this.elastic = new ElasticView(about.reach);  // beside the clip's camera, as long as nobody looks farther
    this.isHeld = false;  // an image that a program asked for stays until a person does something
    this.free = new FreeCamera(about.clipPath);
    this.phase = 0;  // how far a loop has gone, from 0 to 2 pi
  }

  get isFree() {
    return this.mode === "orbit" || this.mode === "fly";
  }

  /** The camera path of this mode, which is neither the clip's own nor that of a person. */
  get path() {
    return this.about.paths.find(({ name }) => this.mode === `path:${name}`);
  }

  camera() {
    if (this.isFree) return this.free.camera;
    const { path } = this;
    if (path) return cameraOf(this.about, path, this.time, this.phase);
    return this.elastic.beside(cameraOnPath(this.about.clipPath, this.time), this.time, this.about.width, this.about.height);
  }

  setMode(mode) {
    this.isHeld = false;
    const before = this.camera();
    const wasFree = this.isFree;
    this.mode = mode;
    if (this.isFree && !wasFree) this.free.startFrom(before);
    if (this.isFree !== wasFree) this.setConfidenceFade(this.isFree && this.knowsGuesses);  // farther away much is a guess
    this.elastic.reset();
    if (this.path?.offsets) {
      this.phase = 0;
      this.setPlaying(false);  // time stands still until it is told to play
    }
    element("camera").value = mode;
    element("farther").setAttribute("aria-pressed", String(this.isFree));
  }

  /** To the clip's camera: by and by, where it is near. */
  goHome() {
    this.isHeld = false;
    if (this.mode === "clip") this.elastic.giveWay();
    else this.setMode("clip");
  }

  setPart(part) {
    this.isHeld = false;
    this.part = part;
  }

  /** What of the scene is shown: a part, and the place of the one object that is (0: of no one object). */
  get shown() {
    const [part, number] = this.part.split(":");
    return { part, only: number ? placeOfObject(this.about, Number(number)) : 0 };
  }

  /** Where the clip's camera is at this time, and how many times as far from there every object is. */
  distances(time = this.time) {
    return { pivot: centerOf(cameraOnPath(this.about.clipPath, time)), factors: [...this.factors] };
  }

  /** Put the object of a number so many times as far from the clip's camera as it was trained; where there is none, nothing happens. */
  setDistance(number, factor) {
    this.isHeld = false;
    const place = placeOfObject(this.about, number);
    if (place) this.factors[place] = factor;
  }

  setStereo(isStereo) {
    this.isHeld = false;
    this.isStereo = isStereo;
  }

  setConfidenceFade(isConfidenceFade) {
    this.isHeld = false;
    this.isConfidenceFade = isConfidenceFade;
    element("confidence-fade").checked = isConfidenceFade;
  }

  /** What happens to that of the scene which the clip does not tell. */
  get guesses() {
    if (!this.knowsGuesses) return "shown";
    return this.isConfidenceFade ? "removed" : "masked";
  }

  setPlaying(isPlaying) {
    this.isHeld = false;
    this.isPlaying = isPlaying;
    element("play").textContent = isPlaying ? "❚❚" : "▶";
    element("play").setAttribute("aria-label", isPlaying ? "Pause" : "Play");
  }

  /** Stop at a clip time. */
  seek(time) {
    this.setPlaying(false);
    this.setTime(Math.min(Math.max(time, 0), 1));
  }

  setTime(time) {
    this.time = time;
    const { first, last } = this.about;
    element("time").value = time;
    element("seconds").textContent = `${(first + time * (last - first)).toFixed(2)} s`;
  }

  step(seconds) {
    this.elastic.step(seconds, this.time);
    if (this.path?.offsets) this.phase = (this.phase + (2 * Math.PI * seconds) / this.path.seconds) % (2 * Math.PI);
    if (!this.isPlaying) return;
    const time = this.time + (this.speed * seconds) / (this.about.last - this.about.first);
    this.setTime(time % 1);
  }
}

/** From 1 on; 0: there is no object of that number. */
function placeOfObject(about, number) {
  return about.objects.findIndex(([other]) => other === number) + 1;
}

/** Size of one image on the page: as large as fits, in the shape of the clip, `eyes` of them beside each other. */
function fit(about, eyes = 1) {
  const stage = element("stage");
  const scale = Math.min(stage.clientWidth / eyes / about.width, stage.clientHeight / about.height);
  const [width, height] = [about.width, about.height].map((n) => Math.max(Math.floor(n * scale), 1));
  for (const shown of [element("canvas"), element("poster")]) {
    shown.style.width = `${eyes * width}px`;
    shown.style.height = `${height}px`;
  }
  return [width, height];
}

class Player {
  constructor(scene, shaders) {
    this.about = scene.about;
    this.canvas = element("canvas");
    this.renderer = new Renderer(this.canvas, scene, shaders);
    this.sorter = new Sorter(scene);
    this.state = new State(scene.about);
    this.controls = new Controls(this.state, this.canvas, scene);
    this.detail = 1;  // share of the screen's pixels that is drawn while things move
    this.slowness = 0;
    this.last = "";  // what was sorted last
    this.isSharp = false;
    this.sorted = null;
    this.isSorting = false;
    this.recording = null;
    this.size = fit(this.about);
    new ResizeObserver(() => this.fit()).observe(element("stage"));
    this.canvas.addEventListener("webglcontextlost", () => complain(new Error("The graphics card was reset: reload the page.")));
    const { state } = this;
    element("play").onclick = () => state.setPlaying(!state.isPlaying);
    element("time").oninput = () => state.seek(Number(element("time").value));
    element("speed").onchange = () => (state.speed = Number(element("speed").value));
    element("camera").onchange = () => state.setMode(element("camera").value);
    element("farther").onclick = () => state.setMode(state.isFree ? "clip" : "orbit");
    element("record").hidden = !Recording.type;
    element("record").onclick = () => this.record();
    offerSharing(scene.about.title);
    element("part").onchange = () => state.setPart(element("part").value);
    element("part").parentElement.hidden = (!scene.about.resting || !scene.about.moving) && scene.about.objects.length < 2;
    offerObjects(state);
    element("confidence-fade").parentElement.hidden = !state.knowsGuesses;
    element("confidence-fade").onchange = () => state.setConfidenceFade(element("confidence-fade").checked);
    element("stereo").onchange = () => {
      state.setStereo(element("stereo").checked);
      this.fit();
    };
  }

  /** Begin a video of what is seen, or end it and save it. */
  record() {
    if (this.recording) {
      this.recording.stop();
      this.recording = null;
    } else {
      this.detail = 1;  // images of one size
      this.recording = new Recording(this.canvas, (video) => save(video, `${this.about.title}.webm`));
    }
    element("record").textContent = this.recording ? "Stop and save" : "Record";
    element("record").setAttribute("aria-pressed", String(Boolean(this.recording)));
  }

  fit() {
    this.size = fit(this.about, this.state.isStereo ? 2 : 1);
  }

  order({ cameras, time, shown, distances }) {
    // All eyes look the same way from the same depth, so that one order serves them.
    const [{ rotation, translation }] = cameras;
    return this.sorter.sort([...rotation.slice(6), translation[2]], time, shown, distances);
  }

  draw({ cameras, time, shown, distances, guesses, width, height }, order) {
    this.renderer.resize(width, height, cameras.length);
    this.renderer.draw(order, cameras, time, shown.part, distances, guesses);
    document.body.classList.add("shown");
  }

  /** What the state asks for now, with this share of the screen's pixels. */
  view(detail) {
    const camera = this.state.camera();
    const [width, height] = this.size.map((n) => Math.max(Math.round(n * detail * Math.min(devicePixelRatio, 2)), 1));
    const [x, y] = [width / this.about.width, height / this.about.height];
    const [fx, fy, cx, cy] = camera.lens;
    const sized = { ...camera, lens: [fx * x, fy * y, cx * x, cy * y] };
    const { time, shown, isStereo, guesses } = this.state;
    const cameras = isStereo ? eyesOf(sized) : [sized];
    return { cameras, time, shown, distances: this.state.distances(), guesses, width, height };
  }

  frame(now) {
    requestAnimationFrame((later) => this.frame(later));
    const seconds = Math.min((now - (this.before ?? now)) / 1000, 0.25);
    this.before = now;
    if (this.state.isHeld) return;
    this.state.step(seconds);
    this.controls.step(seconds);
    if (this.sorted) {
      this.draw(this.sorted.view, this.sorted.order);
      this.sorted = null;
    }
    if (!this.isSorting) this.prepare(seconds);
  }

  /** Have the next image sorted, if it differs from the last: while the one before is drawn, the next is sorted. */
  prepare(seconds) {
    const { time, part, factors, isStereo, isConfidenceFade } = this.state;
    const what = JSON.stringify([this.state.camera(), time, part, factors, isStereo, isConfidenceFade, this.size, devicePixelRatio]);
    const isSame = what === this.last;
    if (isSame && (this.detail === 1 || this.isSharp)) return;
    if (!isSame && !this.recording) this.adapt(seconds);
    this.isSharp = isSame;
    this.last = what;
    const view = this.view(isSame ? 1 : this.detail);  // at rest there is time for all pixels
    this.isSorting = true;
    this.order(view).then((order) => {
      this.sorted = { view, order };
      this.isSorting = false;
    });
  }

  /** Draw fewer pixels where images take long, more where they do not. */
  adapt(seconds) {
    this.slowness += 0.1 * (seconds - this.slowness);
    if (this.slowness > 0.045) this.detail = Math.max(this.detail * 0.97, 0.4);
    else if (this.slowness < 0.025) this.detail = Math.min(this.detail * 1.02, 1);
  }
}

async function start() {
  const about = JSON.parse(element("about").textContent);
  document.body.classList.toggle("embedded", isEmbedded());
  fit(about);
  if (!window.WebGL2RenderingContext) throw new Error(NO_WEBGL);
  if (!window.DecompressionStream) throw new Error("This browser is too old to unpack the scene: it has no DecompressionStream. One from 2023 or later has it.");
  const scene = await readScene(about, element("data").textContent);
  element("data").remove();
  const player = new Player(scene, JSON.parse(element("shaders").textContent));
  player.state.setTime(0);
  const { state } = player;
  Object.assign(window.flowsplat, {
    about,
    state,
    /** Draw the scene for a camera in the coordinates of cameras.json at seconds of the clip; promise of a PNG data address. */
    async show({ viewmat, K, width, height, time }) {
      state.isHeld = true;
      player.last = "";
      const clipTime = (time - about.first) / (about.last - about.first);
      const distances = state.distances(clipTime);
      const { shown } = state;
      const guesses = state.isConfidenceFade ? "removed" : "shown";
      const view = { cameras: [cameraOfScene(about, viewmat, K)], time: clipTime, shown, distances, guesses, width, height };
      player.draw(view, await player.order(view));
      return player.canvas.toDataURL("image/png");
    },
  });
  requestAnimationFrame((now) => player.frame(now));
}

window.flowsplat = {};
window.flowsplat.ready = start();
window.flowsplat.ready.catch(complain);
