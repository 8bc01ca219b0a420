// The view that a person may pull aside and that stays near the clip's camera: turned as far as the clip tells what is seen, with
// growing resistance a little beyond, from where it springs back; and nearer with the lens alone, which shows nothing new.

const MAX_ZOOM = 4;  // times as large as in the clip
const PULL_HEIGHT = 0.3;  // heights of the image that are dragged until the view is as far aside as it stays
const MAX_PULL = 4;  // times as far as the view stays, beyond which pulling counts no more
const SPRING_SECONDS = 0.12;  // in which the way back gets shorter by a factor of e

class ElasticView {
  /** `reach`: radians to either side that the view stays turned by (`safe`) and that it never passes (`stretch`), half as many up and down. */
  constructor({ safe, stretch }) {
    this.safe = safe;
    this.stretch = stretch / safe;
    this.isPulled = false;
    this.isReturning = false;
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

  /** Radians to the left and up by which the view is turned now. A larger image shows the same turn larger: it may be less then. */
  get turn() {
    const pulled = Math.hypot(...this.pull);
    const more = this.stretch - 1;
    const shown = pulled <= 1 ? pulled : 1 + (more > 0 ? more * (1 - Math.exp((1 - pulled) / more)) : 0);
    const share = pulled > 0 ? (shown / pulled) * (this.safe / this.zoom) : 0;
    return [this.pull[0] * share, (this.pull[1] * share) / 2];
  }

  /** Let it spring back, as far as nobody holds it. */
  step(seconds) {
    const left = Math.exp(-seconds / SPRING_SECONDS);
    if (this.isReturning) {
      this.pull = this.pull.map((value) => value * left);
      this.shift = this.shift.map((value) => value * left);
      this.zoom = 1 + (this.zoom - 1) * left;
      if (Math.hypot(...this.pull, ...this.shift, this.zoom - 1) < 1e-3) this.reset();
    } else if (!this.isPulled) {
      const pulled = Math.hypot(...this.pull);
      if (pulled <= 1) return;
      const shorter = pulled < 1.001 ? 1 : 1 + (pulled - 1) * left;
      this.pull = this.pull.map((value) => (value * shorter) / pulled);
    }
  }

  /** The view from beside the clip's camera, whose images have this size: turned round what is at the median depth ahead of it. */
  beside(camera, width, height) {
    const [yaw, pitch] = this.turn;
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
