// The view that a person may pull aside and that stays near the clip's camera: turned as far as the clip tells what is seen, with
// growing resistance a little beyond, from where it springs back; and nearer with the lens alone, which shows nothing new.

const MAX_ZOOM = 4;  // times as large as in the clip
const PULL_HEIGHT = 0.3;  // heights of the image that are dragged until the view is as far aside as the loop goes
const MAX_PULL = 4;  // times as far as that, beyond which pulling counts no more
const REST = 0.8;  // share of the most that the view can be turned from which on it resists
const SPRING_SECONDS = 0.12;  // in which the way back gets shorter by a factor of e

/** What is shown of a pull, both over the most there is: the pull itself, and from REST on less and less. */
function resist(pull) {
  return pull <= REST ? pull : REST + (1 - REST) * (1 - Math.exp((REST - pull) / (1 - REST)));
}

/** The pull of which that much is shown. */
function unresisted(shown) {
  return shown <= REST ? shown : REST - (1 - REST) * Math.log(1 - (shown - REST) / (1 - REST));
}

/** `pulls` [times][directions] at a clip time and an angle from the left over upwards, between what is nearest. */
function pullAt(pulls, time, around) {
  const at = Math.min(Math.max(time, 0), 1) * (pulls.length - 1);
  const k = Math.floor(at);
  const next = Math.min(k + 1, pulls.length - 1);
  const count = pulls[0].length;
  const turns = (((around / (2 * Math.PI)) % 1) + 1) % 1;
  const first = Math.floor(turns * count) % count;
  const share = turns * count - Math.floor(turns * count);
  const of = (row) => row[first] + share * (row[(first + 1) % count] - row[first]);
  return of(pulls[k]) + (at - k) * (of(pulls[next]) - of(pulls[k]));
}

/** How far the loop of bullet time (`move_on_orbit` of geometry/paths.py) goes at such an angle, over its half-width: it is above. */
function loopAt(around) {
  if (Math.sin(around) <= 0) return 0;
  const phase = 2 * Math.atan2(2 * Math.sin(around), Math.cos(around));
  return Math.hypot(Math.sin(phase), (1 - Math.cos(phase)) / 2);
}

class ElasticView {
  /** `angle`: the half-width in radians of the loop; `pulls`: as `LoopWidths` of videos/amplitudes.py has them. */
  constructor({ angle, pulls }) {
    this.angle = angle;
    this.pulls = pulls;
    this.isPulled = false;
    this.reset();
  }

  /** To the clip's camera, at once. */
  reset() {
    this.pull = [0, 0];  // by the hand: to the side and up, over how far the view stays
    this.zoom = 1;
    this.shift = [0, 0];  // of the image, over its width and height
    this.isReturning = false;
  }

  /** To the clip's camera, as `step` is called. */
  giveWay() {
    this.isReturning = true;
  }

  /** Of a hand that moved by shares of the height of the image. */
  drag(x, y) {
    this.isReturning = false;
    const [across, along] = [this.pull[0] + x / PULL_HEIGHT, this.pull[1] + (2 * y) / PULL_HEIGHT];
    const beyond = Math.max(Math.hypot(across, along) / MAX_PULL, 1);
    this.pull = [across / beyond, along / beyond];
  }

  /** How far this pull may turn the view at a clip time, and how far it stays turned, over the half-width of loops. */
  limits(time) {
    const around = Math.atan2(this.pull[1], this.pull[0]);
    const measured = Math.max(pullAt(this.pulls, time, around), 1e-3);
    const loop = loopAt(around);
    return { most: Math.max(measured, loop), stays: Math.max(REST * measured, loop) };
  }

  /** Radians to the left and up by which the view is turned at a clip time. A larger image shows the same turn larger: it is less then. */
  turn(time) {
    const pulled = Math.hypot(...this.pull);
    if (!pulled) return [0, 0];
    const { most } = this.limits(time);
    const share = (most * resist(pulled / most)) / pulled / this.zoom;
    return [this.pull[0] * share * this.angle, (this.pull[1] * share * this.angle) / 2];
  }

  /** Times as near, by the lens. */
  zoomBy(factor) {
    this.isReturning = false;
    this.zoom = Math.min(Math.max(this.zoom * factor, 1), MAX_ZOOM);
    this.shiftBy(0, 0);
  }

  /** Of a hand that moved by shares of the width and height of the image: as far as the image reaches. */
  shiftBy(x, y) {
    this.isReturning = false;
    const most = (this.zoom - 1) / 2;
    this.shift = [x, y].map((step, k) => Math.min(Math.max(this.shift[k] + step, -most), most));
  }

  /** Let it spring back at a clip time, as far as nobody holds it. */
  step(seconds, time) {
    const left = Math.exp(-seconds / SPRING_SECONDS);
    if (this.isReturning) {
      this.pull = this.pull.map((value) => value * left);
      this.shift = this.shift.map((value) => value * left);
      this.zoom = 1 + (this.zoom - 1) * left;
      if (Math.hypot(...this.pull, ...this.shift, this.zoom - 1) < 1e-3) this.reset();
    } else if (!this.isPulled) {
      const pulled = Math.hypot(...this.pull);
      const { most, stays } = this.limits(time);
      // From where the resistance holds it as far as it stays.
      const rest = most * unresisted(Math.min(stays / most, 0.999));
      if (pulled <= rest) return;
      const shorter = pulled < 1.001 * rest ? rest : rest + (pulled - rest) * left;
      this.pull = this.pull.map((value) => (value * shorter) / pulled);
    }
  }

  /** The view from beside the clip's camera at a clip time, whose images have this size: turned round what is at the median depth ahead of it. */
  beside(camera, time, width, height) {
    const [yaw, pitch] = this.turn(time);
    const [a, b, c, d] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const turn = [[a, 0, -b], [-d * b, c, -d * a], [c * b, d, c * a]];
    const axes = rowsOf(camera.rotation);
    const rotation = turn.flatMap((row) => [0, 1, 2].map((k) => row[0] * axes[0][k] + row[1] * axes[1][k] + row[2] * axes[2][k]));
    const center = plus(plus(centerOf(camera), axes[2]), rotation.slice(6), -1);
    const [fx, fy, cx, cy] = camera.lens;
    const { zoom, shift } = this;
    const middle = [width / 2, height / 2];
    return cameraAt(center, rotation, [
      fx * zoom, fy * zoom, middle[0] + zoom * (cx - middle[0]) + shift[0] * width, middle[1] + zoom * (cy - middle[1]) + shift[1] * height,
    ]);
  }
}
