// Cameras: { rotation: 9 numbers by rows, translation: 3, lens: [fx, fy, cx, cy] }, world to camera, x right, y down, z forward.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, k = 1) => [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((x) => x / Math.max(Math.hypot(...a), 1e-12));
const rowsOf = (R) => [R.slice(0, 3), R.slice(3, 6), R.slice(6, 9)];

/** Position of a camera in the world. */
function centerOf({ rotation: R, translation: T }) {
  return [0, 1, 2].map((c) => -(R[c] * T[0] + R[3 + c] * T[1] + R[6 + c] * T[2]));
}

function cameraAt(center, rotation, lens) {
  return { rotation, translation: rowsOf(rotation).map((row) => -dot(row, center)), lens };
}

function rotationOf(quat) {
  const length = Math.hypot(...quat);
  const [w, x, y, z] = quat.map((value) => value / length);
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

/** A vector turned about a unit axis. */
function turned(v, axis, angle) {
  const cos = Math.cos(angle);
  const sin = Math.sin(angle);
  const across = cross(axis, v);
  const along = dot(axis, v) * (1 - cos);
  return v.map((value, k) => value * cos + across[k] * sin + axis[k] * along);
}

/** The clip's own camera at a clip time; rows of `path`: time, center, quaternion, lens. */
function cameraOnPath(path, time) {
  let k = 0;
  while (k < path.length - 2 && path[k + 1][0] <= time) k++;
  const [from, to] = [path[k], path[k + 1]];
  const share = Math.min(Math.max((time - from[0]) / (to[0] - from[0]), 0), 1);
  const row = from.map((value, c) => value + share * (to[c] - value));
  return cameraAt(row.slice(1, 4), rotationOf(row.slice(4, 8)), row.slice(8, 12));
}

/** A camera of the scene's own coordinates (those of cameras.json) in the player's, as geometry/similarity.py does it. */
function cameraOfScene(about, viewmat, K) {
  const { scale, rotation: S, translation } = about.similarity;
  const rotation = [];
  for (let r = 0; r < 3; r++) for (let c = 0; c < 3; c++) rotation.push(dot(viewmat[r], S[c]));
  const shift = rowsOf(rotation).map((row) => dot(row, translation));
  return {
    rotation,
    translation: [0, 1, 2].map((r) => scale * viewmat[r][3] - shift[r]),
    lens: [K[0][0], K[1][1], K[0][2], K[1][2]],
  };
}

/** A camera that a person moves: round a point in front of it, or flying. */
class FreeCamera {
  constructor(path) {
    // The world's down is what the clip's cameras have below them on average.
    const downs = path.map((row) => rotationOf(row.slice(4, 8)).slice(3, 6));
    this.down = unit(downs.reduce((sum, down) => plus(sum, down), [0, 0, 0]));
    this.startFrom(cameraOnPath(path, 0));
  }

  startFrom(camera) {
    this.center = centerOf(camera);
    this.rotation = camera.rotation;
    this.lens = camera.lens;
    this.distance = 1;  // the median depth of the clip
  }

  get camera() {
    return cameraAt(this.center, this.rotation, this.lens);
  }

  turn(yaw, pitch) {
    const [right] = rowsOf(this.rotation);
    // Not over the poles: never more than 86 degrees up or down.
    const below = Math.asin(Math.min(Math.max(dot(rowsOf(this.rotation)[2], this.down), -1), 1));
    const limited = Math.min(Math.max(pitch, below - 1.5), below + 1.5);
    this.rotation = rowsOf(this.rotation).flatMap((row) => turned(turned(row, right, limited), this.down, yaw));
  }

  orbit(yaw, pitch) {
    const target = plus(this.center, rowsOf(this.rotation)[2], this.distance);
    this.turn(yaw, pitch);
    this.center = plus(target, rowsOf(this.rotation)[2], -this.distance);
  }

  /** Along right, down and forward. */
  move(steps) {
    rowsOf(this.rotation).forEach((axis, k) => (this.center = plus(this.center, axis, steps[k])));
  }

  /** Nearer to the point that orbits go round, or farther. */
  zoom(factor) {
    const nearer = Math.min(Math.max(this.distance * factor, 0.05), 50);
    this.move([0, 0, this.distance - nearer]);
    this.distance = nearer;
  }
}
